"""Cameras and poses that are known from elsewhere: a COLMAP model, a NeRF-style transforms.json, a BOP scene."""
