"""Lets torch read nerfstudio's checkpoints without unsafe loading.

nerfstudio's schedulers compute learning rates with numpy, so a checkpoint holds float64 numpy
scalars. torch >= 2.6 refuses any type that it has not been told of, and ns-eval, ns-render,
ns-viewer, ns-export and resuming all fail, for built-in methods too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

# The function that pickle calls to build a numpy scalar; it has no public name.
_numpy_scalar = np.float64(0).__reduce__()[0]

# What one float64 scalar pickles to: that function, a dtype, and the dtype's own class. numpy 2
# gave the function another address; a file may come from either.
_FLOAT64_SCALAR: list[Any] = [
    (_numpy_scalar, "numpy.core.multiarray.scalar"),
    (_numpy_scalar, "numpy._core.multiarray.scalar"),
    np.dtype,
    type(np.dtype(np.float64)),
]


def allow_checkpoint_globals() -> None:
    """Allows `torch.load` to read float64 numpy scalars, and nothing else, in this process.

    Called by every model of this package when it is built, which is before nerfstudio loads a
    checkpoint. Calling it again changes nothing. Older releases of torch load nerfstudio's
    checkpoints as they are, and do not take names beside their list's entries.
    """
    if torch.__version__ >= "2.6":
        torch.serialization.add_safe_globals(_FLOAT64_SCALAR)
