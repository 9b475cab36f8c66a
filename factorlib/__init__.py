"""Materials and light from ordinary photographs: Lambert + GGX per material, an HDR environment map per photo.

Importing this package imports nothing heavy: `from factorlib.reflection import reflection_operator` and the like
load what they need.
"""

__version__ = "0.1.0"
