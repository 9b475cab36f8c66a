"""Steps of the study of the priors on lights: those of spheres, with scores of how coloured the lights are."""
