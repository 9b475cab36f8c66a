"""Steps of the study of speed against error: those of spheres, with the time of each solve, which is no function of the inputs."""
