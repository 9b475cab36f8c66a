"""The studies, a module each; `studies.run` lists them.  docs/studies.md says of each what is varied and measured.

Steps that several studies share, or that take many lines, lie in `studies.steps`.  A study whose cases are measured by one short
function has it here, as the step `main`: an edit of such a module measures its cases anew.  No module imports science at its top.
"""
