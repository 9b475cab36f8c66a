"""Steps of the study of what each part of the model is worth."""
