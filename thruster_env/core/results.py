"""Results of a user's functions, tuples or arrays, as arrays for large models."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from thruster_env.core.compiled import inlined, overloaded, when_compiling
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import is_array, made_here, written_out


@overloaded
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
    names = {"function": inlined(function), "fill": fill, "np": np}
    return written_out("array_valued", arguments, *lines, "out", _loops=True, **names)


@when_compiling
def teach_numba() -> None:
    """Register numba's compilation of `fill`, which depends on the type of the result."""
    from numba import types
    from numba.extending import overload

    @overload(fill, jit_options={"forceinline": False})
    def fill_array(out, value):
        if isinstance(value, types.Array):
            return _copy_vector if value.ndim == 1 else _copy_matrix
        if out.ndim == 1:
            return _by_entries(len(value))
        return _by_rows(len(value))


def _copy_vector(out, value):
    for i in range(out.shape[0]):
        out[i] = value[i]


def _copy_matrix(out, value):
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = value[i, j]


def _by_entries(count: int) -> Callable:
    """Fill from a tuple entry by entry, because entries may differ in type."""
    return written_out(
        "fill_entries", "out, value", *(f"out[{i}] = value[{i}]" for i in range(count)), "None", _loops=True
    )


def _by_rows(count: int) -> Callable:
    lines = (f"fill(out[{i}], value[{i}])" for i in range(count))
    return written_out("fill_rows", "out, value", *lines, "None", _loops=True, fill=fill)
