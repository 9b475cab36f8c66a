"""The stage `solve` on a case: as for spheres."""

from studies.steps.spheres.solve import Params, main

__all__ = ["Params", "main"]
