"""Tests compute the bits that the runner's workers do, whatever `-n` is.

The libraries read these variables when they are loaded, so no plugin of pytest may load one before: see `addopts` in pyproject.toml.
"""

from factorlib.arithmetic import fix

fix()
