"""Ray casting and mesh processing of Open3D, without the rest of the package.

`import open3d` also loads notebook widgets and plots, which need pandas, scikit-learn and Dash: two seconds for each
process, and packages that nothing else here uses. So its compiled module is imported without the package's `__init__`.
"""

import os
import sys
from importlib.util import find_spec, module_from_spec

os.environ["KMP_DUPLICATE_LIB_OK"] = "True"  # Open3D sets it too, since PyTorch brings an OpenMP of its own
_spec = find_spec("open3d")
assert _spec is not None  # pyproject.toml asks for it
sys.modules["open3d"] = module_from_spec(_spec)
from open3d.cpu.pybind import core, geometry, t, utility  # noqa: E402, F401

del sys.modules["open3d"]  # any other `import open3d` gets the whole package
