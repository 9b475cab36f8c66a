"""Tests compute the bits that the runner's workers do."""

from factorlib.arithmetic import fix

fix()
