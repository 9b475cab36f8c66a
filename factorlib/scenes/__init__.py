"""Made scenes of known answer that tests and studies share.

bodies           meshes without symmetry, and coarse copies of them
joint_problems   spheres of known materials in lights made of lobes
operator_cases   special cases of the reflection operators, and laws of theirs
stage_runs       stages run on a data set without the runner
"""
