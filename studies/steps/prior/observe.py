"""What a case sees: as for spheres."""

from studies.steps.spheres.observe import Params, main

__all__ = ["Params", "main"]
