"""Materials and light from ordinary photographs: Lambert + GGX per material, an HDR environment map per light.

Importing this package imports nothing heavy.  `from factorlib.reflection import reflection_operator` and the like load
what they need.  `factorlib.load_result` is also loaded on first access.
"""

import os
from importlib import import_module
from typing import Any

os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")  # Open3D would start it in every notebook.
__version__ = "0.3.0"
__all__ = ["__version__", "load_result"]


def __getattr__(name: str) -> Any:
    if name == "load_result":
        return import_module("factorlib.result").load_result  # by name, so that no stage's key depends on it
    raise AttributeError(f"module 'factorlib' has no attribute {name!r}")
