"""The runner: which steps there are, which of them must run and why, and running them.

`plan` decides, as a pure function of what is declared, what everything hashes to and what the store holds; every verb
renders or executes that one result.  Nothing here imports a stage, science, numpy or torch.
"""
