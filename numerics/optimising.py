"""Machine code of called functions is optimised once, within the function that is asked for, not level by level.

numba optimises each function together with all that it calls. For a filter of a large model, whose functions call
one another over many levels, that would be most of the time of a compilation.
"""

from __future__ import annotations

from collections.abc import Callable


def optimise_once(is_called: Callable[[Callable], bool]) -> None:
    """Leave functions as they are when they are compiled for a caller; those that are asked for are optimised.

    Without the place in numba that this needs, everything still works, and takes longer to compile.

    Args:
        is_called: whether a plain function is one to leave.
    """
    from numba.core import codegen, event

    library = getattr(codegen, "CPUCodeLibrary", None)
    optimise = getattr(library, "_optimize_final_module", None)
    if optimise is None:
        return
    compiling: list[Callable] = []  # a function, for which another is compiled, and so on; numba holds a lock

    class Compiling(event.Listener):
        def on_start(self, event):
            compiling.append(event.data["dispatcher"].py_func)

        def on_end(self, event):
            compiling.pop()

    event.register("numba:compile", Compiling())

    def optimise_unless_called(self):
        if not (compiling and is_called(compiling[-1])):
            optimise(self)

    library._optimize_final_module = optimise_unless_called
