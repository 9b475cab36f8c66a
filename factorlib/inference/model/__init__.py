"""Model: observations, lights, materials, their priors and errors, and the radiance that they predict."""
