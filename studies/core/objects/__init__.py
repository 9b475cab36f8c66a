"""Cases that show objects which are no spheres, so that where an object is, how it is turned and what mesh stands for it can be wrong."""
