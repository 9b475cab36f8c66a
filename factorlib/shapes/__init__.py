"""Shapes of objects that no mesh is given of, and cameras, from masks and photos: hulls, bodies of revolution, primitives, structure from motion."""
