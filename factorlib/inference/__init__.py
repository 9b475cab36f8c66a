"""Inference of one reflectance per material and one light per illumination, from all photos at once.

The method is photometric bundle adjustment.  Every observation depends on one material (7 unknowns) and one
illumination (3 unknowns a cell, plus exposures and tone curves of its photos).  The normal equations therefore have
arrow shape, and the illuminations are eliminated one by one (Schur complement).

Rooms, from below, each of which imports those before it alone; modules in the order in which they are best read:

options      Options of the solvers.
model        blocks (observations by illumination, noise, robust losses), observed (their source), lights, materials,
             forward (radiance and derivatives), responses (reflection of cells), interreflection, cast_shadows,
             background, normal_errors, material_prior, known, gauge, problem (any point), misfit
fit          likelihood (the objective), optimizer, exposures (their balance against reflectances), fit
             (hyperparameters), fit_runner (states and events), start (initial values)
choices      model_selection, splitting, suns
answer       uncertainty, material_posterior, identifiability, answer (the form that is written)
surface      surface_detail (the choice), surface_turns (normals from shading), texture, aligned_photo, light_selection
             (of many lights)

joint_solver is the method's page: its steps.  held_out_photos fits lights to its materials; paper_solver is the
baseline.
"""
