"""The same bits on every processor: which instructions the numerical libraries may use, said in their own environment variables.

NumPy, OpenBLAS, PyTorch and MKL choose their kernels by what the processor offers, and kernels differ in the order of their sums.
One rounding error can lead a solve into another local minimum of its loss.  So all of them are limited to AVX2, which every x86-64 processor
has had since 2013 (Haswell, Zen; x86-64-v3), and MKL to the code that it runs on processors of any maker.  On other architectures the
variables mean nothing, and results agree to rounding alone.

They are read when a library is loaded: the runner sets them before its workers start, tests and studies before they import.
"""

import os

VARIABLES = {
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Haswell",
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_CBWR": "COMPATIBLE",
}


def fix() -> None:
    """Set it for this process, before it imports a numerical library, and for those that it starts."""
    os.environ.update(VARIABLES)
