"""The joint problem: one reflectance per material and one light per illumination, from all photos at once.

Photometric bundle adjustment.  Every observation touches one material (7 unknowns) and one illumination (6 a
lobe), so the normal equations have an arrow shape and the illuminations are eliminated one by one (Schur).
"""
