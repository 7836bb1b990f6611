"""Machine code is optimised once, for the outermost function, and not for each function that it calls.

numba compiles each function for itself, together with all that it calls, as if Python could call it, too. For a
filter of a large model, whose functions call one another over many levels, that would be most of the time.

Our loops also get vectors of 512 bits if the processor has them. LLVM would take 256 on Intel's, for the sake of
the first ones with 512, which slowed down.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Container
from functools import wraps
from typing import Any, NamedTuple

WIDE = '"prefer-vector-width"="512"'  # as LLVM writes it among the attributes of a function

RARELY = 1_000_000  # new objects after which garbage is collected meanwhile


class Which(NamedTuple):
    """Which plain functions are compiled differently."""

    asked: Container[Callable | None]  # ours to compile; of others' functions nothing is changed
    marked: Container[Callable | None]  # those that become part of these
    called: Container[Callable | None]  # of those, the ones to leave as they are
    apart: Container[Callable | None]  # of these, the ones that never become part of a caller


def optimise_once(which: Which) -> None:
    """Optimise only the outermost function of a compilation, not the functions compiled for its calls.

    Of those that only compiled code can call no machine code is made by itself. Without the places in numba that
    this needs, everything still works, and takes longer to compile. What others compile is untouched, and so is
    what numba makes of its own, or of others' functions, on the way.
    """
    from numba.core import codegen, event

    library = getattr(codegen, "CPUCodeLibrary", None)
    if not hasattr(library, "_optimize_final_module") or not hasattr(library, "_optimize_functions"):
        return
    compiling = _listener(event.Listener, which.asked)
    event.register("numba:compile", compiling)
    _widen_vectors(library, compiling, which)
    _optimise_outermost(library, compiling, which)
    _emit_outermost(library, getattr(codegen, "JITCPUCodegen", None), compiling, which)


def _listener(base: type, asked: Container[Callable | None]):
    """Keeps what is being compiled for a function of ours, which leaves hardly any garbage to collect.

    numba holds a lock from the start to the end, which it tells however a compilation ends.
    """

    class Compiling(base):
        def __init__(self):
            self.dispatchers: list = []  # of the function, of one compiled for it, and so on
            self.thresholds: tuple | None = None  # of garbage collection before

        def on_start(self, event):
            dispatcher = event.data["dispatcher"]
            if not self.dispatchers:
                if dispatcher.py_func not in asked:
                    return
                self.thresholds = gc.get_threshold()
                gc.set_threshold(RARELY, *self.thresholds[1:])
            self.dispatchers.append(dispatcher)

        def on_end(self, event):
            ended = [other is event.data["dispatcher"] for other in self.dispatchers]
            if True in ended:
                del self.dispatchers[ended.index(True) :]
            if not self.dispatchers and self.thresholds is not None:
                if gc.get_threshold()[0] == RARELY:  # nobody else has changed it meanwhile
                    gc.set_threshold(*self.thresholds)
                self.thresholds = None

        @property
        def outermost(self) -> Callable | None:
            """The function of ours that is being compiled, or None."""
            return self.dispatchers[0].py_func if self.dispatchers else None

        def function_of(self, library) -> Callable | None:
            """The innermost function that a library is compiled from; None if there is none."""
            function = self.dispatchers[-1].py_func if self.dispatchers else None
            return function if function is not None and library.name == function.__qualname__ else None

    return Compiling()


def _widen_vectors(library: Any, compiling, which: Which) -> None:
    add = getattr(library, "add_ir_module", None)
    if add is None:
        return

    @wraps(add)
    def add_widened(self, module):
        function = compiling.function_of(self)
        ours = function is compiling.outermost or function in which.marked
        if function is not None and ours:
            for part in module.functions:
                if not part.is_declaration:
                    set.add(part.attributes, WIDE)  # its own `add` knows attributes without a value only
        add(self, module)

    library.add_ir_module = add_widened


def _optimise_outermost(library: Any, compiling, which: Which) -> None:
    optimise, optimise_functions = library._optimize_final_module, library._optimize_functions

    @wraps(optimise)
    def optimise_outermost(self):
        function = compiling.function_of(self)
        if compiling.outermost in (None, function) or function not in which.called:
            optimise(self)
        elif function in which.apart:
            for part in self._final_module.functions:
                if not part.is_declaration and b"alwaysinline" not in b" ".join(part.attributes):
                    part.add_function_attribute("noinline")

    @wraps(optimise_functions)
    def optimise_other_functions(self, module):
        if compiling.outermost is None or compiling.function_of(self) is not compiling.outermost:
            optimise_functions(self, module)
        else:  # the passes over the whole module do this once more: with both, filters take a tenth longer
            module.data_layout = self._codegen._data_layout

    library._optimize_final_module, library._optimize_functions = optimise_outermost, optimise_other_functions


def _emit_outermost(library: Any, codegen: Any, compiling, which: Which) -> None:
    """Make no machine code of functions without a wrapper for Python: their callers contain them."""
    names = "_finalize_final_module", "_finalize_dynamic_globals"
    if not all(hasattr(library, name) for name in names) or not hasattr(codegen, "set_env"):
        return
    emit, set_environment = library._finalize_final_module, codegen.set_env
    waiting: dict = {}  # by name, the environments of functions of which there is no machine code yet

    @wraps(emit)
    def emit_outermost(self):
        function = compiling.function_of(self)
        if function is not None and function is not compiling.outermost and function in which.marked:
            self._finalize_dynamic_globals()
            self._finalized = True
        else:
            emit(self)

    @wraps(set_environment)
    def set_what_is_there(self, name, environment):
        waiting[name] = environment
        for present in [name for name in waiting if self._engine.get_global_value_address(name)]:
            set_environment(self, present, waiting.pop(present))

    library._finalize_final_module, codegen.set_env = emit_outermost, set_what_is_there
