"""Machine code of called functions is optimised once, within the function that is asked for, not level by level.

numba optimises each function together with all that it calls. For a filter of a large model, whose functions call
one another over many levels, that would be most of the time of a compilation.
"""

from __future__ import annotations

from collections.abc import Callable

LEVEL = 2  # of LLVM's optimisation of large functions: of the third, loops over long rows gain a tenth

LEVEL_INSIDE = 1  # of what becomes part of these, and is then optimised once more


def optimise_once(is_called: Callable[[Callable], bool], is_large: Callable[[Callable], bool]) -> None:
    """Leave called functions as they are when they are compiled for a caller; what is asked for is optimised.

    Without the places in numba that this needs, everything still works, and takes longer to compile.

    Args:
        is_called: whether a plain function is one to leave.
        is_large: whether a function that is asked for calls such functions.
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

    def optimise_outermost(self):
        if not compiling or not is_large(compiling[0]):
            optimise(self)
        elif not is_called(compiling[-1]):
            options = self._codegen
            before = getattr(options, "_opt_level", None)
            try:
                options._opt_level = before and min(before, LEVEL if len(compiling) == 1 else LEVEL_INSIDE)
                optimise(self)
            finally:
                options._opt_level = before

    library._optimize_final_module = optimise_outermost
