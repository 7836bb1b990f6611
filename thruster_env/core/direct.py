"""Compiled functions called without a look at the types of their arguments, where that would take longest."""

from __future__ import annotations

from collections.abc import Callable

from thruster_env.core.compiled import CompiledOrPython


def direct(function: Callable, *arguments) -> Callable:
    """The machine code that a compiled function has for arguments like these, to be called with such ones only.

    At every call numba finds out the type of each argument, which takes 0.2 us where three are arrays, and then
    calls what this returns. Arrays must stay of the same number of dimensions, dtype, layout and writability, so
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
