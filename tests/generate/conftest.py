"""Tests render with the variant of Mitsuba that runs everywhere and compiles nothing."""

import os

os.environ["FACTORLIB_MITSUBA"] = "scalar_rgb"
