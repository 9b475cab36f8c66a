"""Unstructured reflectance maps: observations (normal, view, radiance) of each material, without pixel order."""
