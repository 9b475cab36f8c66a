"""Elementary functions of tensors that round alike on every processor (see factorlib.arithmetic).

torch.sqrt is MKL's, which is off by one unit in the last place now and then, and not at the same places on every processor.
torch's products are MKL's, too, whose code for processors of any maker is five times slower than OpenBLAS, which NumPy calls.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor


def square_root(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """√x as IEEE 754 rounds it, without derivative.

    >>> square_root(torch.tensor([0.0, 4.0]))
    tensor([0., 2.])
    """
    return torch.from_numpy(np.sqrt(x.numpy()))


def product(a: Float[Tensor, "n k"], b: Float[Tensor, "k ..."]) -> Float[Tensor, "n ..."]:
    """The product of two matrices, or of a matrix and a vector, without derivative.

    >>> product(torch.eye(2), torch.tensor([3.0, 4.0]))
    tensor([3., 4.])
    """
    return torch.from_numpy(np.asarray(a.numpy() @ b.numpy()))
