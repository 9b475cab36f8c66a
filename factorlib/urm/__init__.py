"""Unstructured reflectance maps: what was seen of each material, as (normal, view, radiance) without pixel order."""
