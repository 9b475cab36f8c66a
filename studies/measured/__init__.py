"""Measurements: what is computed here is the bits that the runner's workers compute."""

from factorlib.arithmetic import fix

fix()
