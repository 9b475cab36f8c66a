"""The studies, a module each; `studies.run` lists them.  docs/studies.md says of each what is varied and measured.

What is done for each case are the steps in `studies.steps`.  No module imports science at its top.
"""
