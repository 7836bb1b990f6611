"""Machine code is made and optimised once, for the function that is asked for, and not for each that it calls.

numba compiles each function for itself, together with all that it calls, as if Python could call it, too. For a
filter of a large model, whose functions call one another over many levels, that would be most of the time.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from functools import wraps

LEVEL = 2  # of LLVM's optimisation of large functions: of the third, loops over long rows gain a tenth

LEVEL_INSIDE = 1  # of what becomes part of these, and is then optimised once more

Which = Callable[[Callable], bool]


def optimise_once(is_called: Which, is_large: Which, is_apart: Which) -> None:
    """Leave called functions as they are when they are compiled for a caller; what is asked for is optimised.

    Of those that only compiled code can call no machine code is made by itself. Without the places in numba that
    this needs, everything still works, and takes longer to compile.

    Args:
        is_called: whether a plain function is one to leave.
        is_large: whether a function that is asked for calls such functions.
        is_apart: whether a function that is called is never to become part of a caller.
    """
    from numba.core import codegen, event

    library = getattr(codegen, "CPUCodeLibrary", None)
    if not hasattr(library, "_optimize_final_module"):
        return
    compiling: list = []  # the dispatchers of a function, of one compiled for it, and so on; numba holds a lock
    listener = _listener(event.Listener, compiling)
    event.register("numba:compile", listener)
    _optimise_outermost(library, compiling, (is_called, is_large, is_apart))
    _emit_outermost(library, getattr(codegen, "JITCPUCodegen", None), compiling)


def _listener(base: type, compiling: list):
    """Keeps the list of what is being compiled, during which no garbage is collected: there is hardly any."""

    class Compiling(base):
        collecting = False  # whether garbage was collected before

        def on_start(self, event):
            if not compiling:
                self.collecting = gc.isenabled()
                gc.disable()
            compiling.append(event.data["dispatcher"])

        def on_end(self, event):
            compiling.pop()
            if not compiling and self.collecting:
                gc.enable()

    return Compiling()


def _optimise_outermost(library: type, compiling: list, which: tuple[Which, Which, Which]) -> None:
    optimise, (is_called, is_large, is_apart) = library._optimize_final_module, which

    @wraps(optimise)
    def optimise_outermost(self):
        function = compiling[-1].py_func if compiling else None
        if not compiling or not is_large(compiling[0].py_func):
            optimise(self)
        elif not is_called(function):
            options = self._codegen
            before = getattr(options, "_opt_level", None)
            try:
                options._opt_level = before and min(before, LEVEL if len(compiling) == 1 else LEVEL_INSIDE)
                optimise(self)
            finally:
                options._opt_level = before
        elif is_apart(function):
            for part in self._final_module.functions:
                if not part.is_declaration and function.__name__ in part.name:
                    part.add_function_attribute("noinline")

    library._optimize_final_module = optimise_outermost


def _emit_outermost(library: type, codegen: type | None, compiling: list) -> None:
    """Make no machine code of functions without a wrapper for Python: their callers contain them."""
    names = "_finalize_final_module", "_finalize_dynamic_globals"
    if not all(hasattr(library, name) for name in names) or not hasattr(codegen, "set_env"):
        return
    emit, set_environment = library._finalize_final_module, codegen.set_env
    waiting: dict = {}  # by name, the environments of functions of which there is no machine code yet

    @wraps(emit)
    def emit_outermost(self):
        if len(compiling) > 1 and getattr(compiling[-1], "targetoptions", {}).get("no_cpython_wrapper"):
            self._finalize_dynamic_globals()
            self._finalized = True
        else:
            emit(self)

    @wraps(set_environment)
    def set_what_is_there(self, name, environment):
        waiting[name] = environment
        for there in [name for name in waiting if self._engine.get_global_value_address(name)]:
            set_environment(self, there, waiting.pop(there))

    library._finalize_final_module, codegen.set_env = emit_outermost, set_what_is_there
