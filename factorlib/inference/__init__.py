"""Inference: one reflectance per material and one light per illumination, from all photos at once.

Photometric bundle adjustment.  Every observation touches one material (7 unknowns) and one illumination (3 a cell, and the exposures and tone
curves of its photos), so the normal equations have an arrow shape and the illuminations are eliminated one by one (Schur).

The method     joint_solver (its steps), model_selection and evidence (choices by held-out observations), suns, surface_detail with
               surface_turns and surface_attach (normals by shading), paper_solver (the baseline)
The fit        fit (materials and lights together), likelihood (what is minimised), priors (of materials), optimizer and arrow (how)
The model      problem (every question about a point), forward (radiance and derivatives), responses (what cells reflect), lights, materials,
               noise, interreflection, known
The data       observed and blocks (observations by illumination), start (where a solve starts), resume (steps that are kept)
The answer     gauge, uncertainty, identifiability, misfit, answer, history
"""
