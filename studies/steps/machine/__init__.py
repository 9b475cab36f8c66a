"""Steps of the study of seeds and machines."""
