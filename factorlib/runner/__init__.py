"""Runner of the pipeline: it plans which steps must run, and why, and runs them.

The plan is a pure function of the declared stages, the hashes of their inputs and the content of the store.  Every verb
prints or executes that plan.  Nothing here imports a stage, numpy or torch.
"""
