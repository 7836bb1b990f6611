"""Calls of compiled functions that skip numba's dispatch on the types of arguments."""

from __future__ import annotations

from collections.abc import Callable

from thruster_env.core.compiled import CompiledOrPython


def direct(function: Callable, *arguments) -> Callable:
    """The machine code of a compiled function for the types of these arguments; call it with such arguments only.

    At every call numba determines the type of each argument, which takes 0.2 us for three arrays, and then calls
    this machine code. Arrays must stay of the same number of dimensions, dtype, layout and writability, so
    it is meant for a memory of one's own.

    Args:
        function: compiled by `thruster_env.core.compiled`, and called before with arguments of these types;
            one that was not, or that runs as Python, is returned as it is.
        arguments: those of the calls to come, or others of their types.
    """
    compiled = function.direct if isinstance(function, CompiledOrPython) else function
    overloads = getattr(compiled, "overloads", None)
    if not overloads:
        return compiled
    from numba import typeof

    overload = overloads.get(tuple(typeof(argument) for argument in arguments))
    return compiled if overload is None else overload.entry_point
