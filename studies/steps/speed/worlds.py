"""The lights of all worlds: as for spheres."""

from studies.steps.spheres.worlds import Params, main

__all__ = ["Params", "main"]
