"""Results of a user's functions, tuples or arrays, as arrays for large models."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import is_array, made_here, written_out


def fill(out, value):
    """Copy a vector or matrix, in whatever form, into an array."""
    out[...] = value


@makes_functions
def array_valued(function: Callable, arguments: str, *shape: int) -> Callable:
    """Return a function whose result is an array where vectors or matrices of its shape are (`is_array`).

    So a user's function may return tuples, or arrays, of any size.
    """
    return function if made_here(function) else as_array(function, arguments, *shape)


def as_array(function: Callable, arguments: str, *shape: int) -> Callable:
    """Return a function with the same result as an array, for a function that returns a tuple of this shape."""
    if not is_array(*shape):
        return function
    lines = f"out = np.empty({shape})", f"fill(out, function({arguments}))"
    names = {"function": function, "fill": fill, "np": np}
    return written_out("array_valued", arguments, *lines, "out", **names)
