"""Why a function runs as Python: no compilation, a model that nothing compiles, a broken function, a full disk."""

import functools
import runpy
import threading
import warnings

import numpy as np
import pytest

import thruster_env.core.compiled
from thruster_env.core import compiled
from thruster_env.core.compiled import Instead, compiled_in_place_of
from thruster_env.core.sources import Source
from thruster_env.graphs import loops
from thruster_env.graphs.loops import Loops
from thruster_env.model.traced import called_function

FAULT = "a fault of the package and not of the model: please report it"


def broken_maker(n: int):
    """A function with a name that it does not define."""
    return Source("magnitude", "row", work=n).function("cov + 1.0")


def called_by_ours(function):
    """A function of ours that calls another one."""

    def outer(x):
        x[0] = function(x[0]) + 1.0

    outer.__module__ = "filters.engine.of_a_test"  # as if it were
    return outer


def of_text(x, c):
    """A user's function that nothing compiles."""
    return (float(f"{x[0]:.3f}"),)


class Times:
    """A user's object in the place of a function, which looks numbers up."""

    table = {1.0: 1.0, 2.0: 2.0}

    def __call__(self, x, c):
        """Return x."""
        return (self.table[x[0]],)


def warning_of(function) -> str:
    """What is said at the first call, and that there is no more."""
    run = Loops(called_by_ours(function))
    with pytest.warns(UserWarning, match="runs as Python") as caught:
        try:
            run(np.array([2.0]))
        except NameError as error:
            assert "cov" in str(error)
    (said,) = (str(one.message) for one in caught if "runs as Python" in str(one.message))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*runs as Python")
        if FAULT not in said:
            run(np.array([2.0]))
    return said


def test_a_broken_function_of_ours_is_a_fault_to_report():
    said = warning_of(broken_maker(3))
    assert said.endswith(FAULT) and "\n" not in said
    assert "magnitude" in said and "cov" in said


@pytest.mark.parametrize("function", [of_text, Times(), functools.partial(of_text)])
def test_a_model_that_numba_refuses_is_none(function):
    of_model = called_function(function, "x, c", (1, 0), 0, (1,))

    def first(x):
        return of_model((x,), ())[0]

    said = warning_of(first)
    assert said.startswith(f"{compiled.IN_PYTHON}: ") and "cannot be traced" in said and "numba" in said
    assert FAULT not in said


def test_a_disk_without_room_is_neither(monkeypatch):
    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(loops, "code_of", full)
    x = np.array([-2.0])
    with pytest.warns(UserWarning, match="machine code of it could not be made: .*No space left"):
        Loops(called_by_ours(abs))(x)
    assert x[0] == 3.0


def test_what_compiles_is_quiet():
    x = np.array([-2.0])
    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*runs as Python")
        Loops(called_by_ours(abs))(x)
    assert x[0] == 3.0


def test_a_second_thread_waits_for_the_machine_code_of_what_it_calls():
    def replaced(x):
        return -x

    def doubled(x):
        return 2.0 * x

    def find():
        thread.start()  # that compiles while this one traces
        thread.join(0.3)
        return Instead(doubled)

    one, other = np.array([2.0]), np.array([2.0])
    compiled_in_place_of(replaced, find)
    thread = threading.Thread(target=lambda: Loops(called_by_ours(replaced))(other))
    Loops(called_by_ours(replaced))(one)
    thread.join()
    assert (one[0], other[0]) == (5.0, 5.0)


@pytest.mark.parametrize("value, runs_as_python", [("1", True), ("0", False), ("", False)])
def test_the_environment_variable_of_numba_leaves_functions_as_they_are(value, runs_as_python, monkeypatch):
    monkeypatch.setenv("NUMBA_DISABLE_JIT", value)
    found = runpy.run_path(thruster_env.core.compiled.__file__)
    assert found["is_interpreting"]() == runs_as_python
