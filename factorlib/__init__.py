"""Materials and light from ordinary photographs: Lambert + GGX per material, an HDR environment map per photo.

Importing this package imports nothing heavy: `from factorlib.reflection import reflection_operator` and the like
load what they need, and `factorlib.load_result` does so when it is first asked for.
"""

import os
from importlib import import_module
from typing import Any

os.environ.setdefault("OPEN3D_DISABLE_WEB_VISUALIZER", "true")  # which it would start in every notebook
__version__ = "0.2.0"
__all__ = ["__version__", "load_result"]


def __getattr__(name: str) -> Any:
    if name == "load_result":
        return import_module("factorlib.result").load_result  # by name at run time: no stage's result depends on it
    raise AttributeError(f"module 'factorlib' has no attribute {name!r}")
