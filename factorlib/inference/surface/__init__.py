"""Surface: normals from shading, paint, and the lights that they are estimated from."""
