"""Images: photos, light maps and pictures as files, and their exposure, tone and lens."""
