"""Cameras and poses from external sources: a COLMAP model, a NeRF-style transforms.json, a BOP scene."""
