"""Inference of one reflectance per material and one light per illumination, from all photos at once.

The method is photometric bundle adjustment.  Every observation depends on one material (7 unknowns) and one
illumination (3 unknowns a cell, plus exposures and tone curves of its photos).  The normal equations therefore have
arrow shape, and the illuminations are eliminated one by one (Schur complement).

Method   joint_solver (its steps), model_selection and evidence (choices by held-out observations), suns, surface_detail
         with surface_turns and surface_attach (normals from shading), paper_solver (the baseline)
Fit      fit (materials and lights together), likelihood (the objective), priors (of materials), optimizer and arrow
Model    problem (every question about a point), forward (radiance and derivatives), responses (reflection of cells),
         lights, materials, noise, interreflection, known
Data     observed and blocks (observations by illumination), start (initial values), resume (checkpoints of steps)
Results  gauge, uncertainty, identifiability, misfit, answer, history
"""
