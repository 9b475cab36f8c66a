"""Made scenes of known answer that tests and studies share.

bodies            meshes without symmetry, and coarse copies of them
joint_problems    spheres of known materials in lights made of lobes
operator_variant  reflection operators by precision, compiled or not
stage_runs        stages run on a data set without the runner
"""
