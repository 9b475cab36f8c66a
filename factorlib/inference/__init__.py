"""Inference of one reflectance per material and one light per illumination, from all photos at once.

The method is photometric bundle adjustment.  Every observation depends on one material (7 unknowns) and one
illumination (3 unknowns a cell, plus exposures and tone curves of its photos).  The normal equations therefore have
arrow shape, and the illuminations are eliminated one by one (Schur complement).

The modules in the order in which they are best read:

Data     blocks (observations by illumination, noise model, robust losses), observed (their source), lights, materials
Model    forward (radiance and derivatives), responses (reflection of cells), interreflection, problem (any point)
Fit      material_prior, likelihood (the objective), optimizer, exposures (their balance against reflectances), fit
         (hyperparameters), start (initial values)
Method   joint_solver (its steps), fit_runner (states and events), model_selection, splitting, suns; options, known
Surface  surface_detail (the choice), surface_turns (normals from shading)
Results  uncertainty, material_posterior (prior against errors of the model), gauge, identifiability, misfit, answer,
         held_out_photos
Rival    paper_solver (the baseline)
"""
