"""Renderings of a solution: photos re-rendered, balls and reflectance maps of any material in any light."""
