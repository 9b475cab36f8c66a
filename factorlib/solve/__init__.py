"""The joint problem solved: one reflectance per material and one light per illumination, from all photos at once.

Photometric bundle adjustment.  Every observation touches one material (7 unknowns) and one illumination (6 a
lobe), so the normal equations have an arrow shape and the illuminations are eliminated one by one (Schur).

    bundle      the solver: rounds, choices, polish
    rounds      lobes are inserted where residuals are large, as long as held-out observations are explained better
    descent     Levenberg–Marquardt: step (arrow, bounds), control (damping, termination), weights
    evidence    compare: which of two models explains held-out observations better; thresholds
    paper       the paper's solver, the baseline

What photos should show, and all derivatives, is in `factorlib.model`.
"""
