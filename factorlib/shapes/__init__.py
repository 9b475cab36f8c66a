"""Shapes of objects without a given mesh, and cameras, from masks and photos.

The methods are visual hulls, bodies of revolution, primitives, and structure from motion.
"""
