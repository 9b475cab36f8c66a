"""Errors of pictures, materials, light and geometry, each beside the score of a null."""
