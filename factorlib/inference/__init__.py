"""The joint problem solved: one reflectance per material and one light per illumination, from all photos at once.

Photometric bundle adjustment.  Every observation touches one material (7 unknowns) and one illumination (3 a cell, and the exposures and tone curves of its photos), so the normal equations
have an arrow shape and the illuminations are eliminated one by one (Schur).

    solve       the solver: choices, materials, splitting, lights
    choices     what a scene needs of the model: shadows, bounces, tone curves, distances;  suns: one a light;  evidence: how held-out
                observations decide
    fit         materials and lights fitted together, and how much observations and prior count
    arrow       the arrow-shaped system, and its elimination;  descent: Levenberg–Marquardt on it
    marginal    what is minimised: the marginal likelihood, the lights integrated out;  material_prior: what is expected of materials
    start       where a solve starts, from nothing or from an earlier solution;  resume: parts that are done already
    few_lobes   another solver, for exact scenes: lights are few lobes with free axes;  it decides nothing for the first
    paper       the paper's solver, the baseline

What photos should show, and the main solver's derivatives, are in `factorlib.model`.
"""
