"""Why a function runs as Python: a model that numba refuses, a broken function of the package, a full disk."""

import functools
import threading
import warnings

import pytest

from thruster_env.core import compiled
from thruster_env.core.compiled import CompiledOrPython, Instead, compiled_in_place_of
from thruster_env.core.sources import Source, written_out

FAULT = "a fault of the package and not of the model: please report it"


def broken_maker(n: int):
    """A function with a name that it does not define."""
    return Source("magnitude", "row", work=n).function("cov + 1.0")


def called_by_ours(function):
    """A function of ours that calls another one."""
    inner = written_out("inner", "x", "function(x)", function=function)

    def outer(x):
        return inner(x) + 1.0

    outer.__module__ = "filters.engine.of_a_test"  # as if it were
    return outer


def of_text(x):
    """A user's function that numba refuses."""
    return float(f"{x:.3f}")


NUMBERS = {"gain": 1.0}


def of_dictionary(x):
    """Another one, which numba compiles later."""
    return NUMBERS["gain"] * x


class Times:
    """A user's object in the place of a function."""

    def __call__(self, x):
        """Return x."""
        return 1.0 * x


def warning_of(function) -> str:
    """What is said at the first call, and that there is no more."""
    run = CompiledOrPython(called_by_ours(function))
    with pytest.warns(UserWarning, match="runs as Python") as caught:
        try:
            run(2.0)
        except NameError as error:
            assert "cov" in str(error)
    (said,) = (str(one.message) for one in caught if "runs as Python" in str(one.message))
    return said


def test_a_broken_function_of_ours_is_a_fault_to_report():
    said = warning_of(broken_maker(3))
    assert said.endswith(FAULT) and "\n" not in said
    assert "magnitude, written out by" in said and "broken_maker(3)" in said and "'cov' is not defined" in said


def test_a_broken_outermost_function_is_a_fault_to_report():
    def outer(x):
        return x + nowhere  # noqa: F821 - that is the fault

    outer.__module__ = "filters.engine.of_a_test"
    fault = f"numba refuses outer of filters.engine.of_a_test: .*nowhere.*{FAULT}"
    with pytest.warns(UserWarning, match=fault), pytest.raises(NameError):
        CompiledOrPython(outer)(2.0)


@pytest.mark.parametrize("function", [of_text, of_dictionary, Times(), functools.partial(of_text)])
def test_a_model_that_numba_refuses_is_none(function):
    said = warning_of(function)
    assert said.startswith(f"{compiled.IN_PYTHON}: numba refuses it: ") and FAULT not in said
    assert "runs as Python" in said


def test_a_disk_without_room_is_neither(monkeypatch):
    def full(function):
        def run(*arguments):
            raise OSError(28, "No space left on device")

        return run

    monkeypatch.setattr(compiled, "compiled", full)
    with pytest.warns(UserWarning, match="machine code of it could not be made: .*No space left"):
        assert CompiledOrPython(called_by_ours(abs))(-2.0) == 3.0


def test_what_compiles_is_quiet():
    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*runs as Python")
        assert CompiledOrPython(called_by_ours(abs))(-2.0) == 3.0


def test_a_second_thread_waits_for_the_machine_code_of_what_it_calls():
    def replaced(x):
        return -x

    def first(x):
        return replaced(x)

    def second(x):
        return replaced(x) + 1.0

    def find():
        thread.start()  # that compiles while this one traces
        thread.join(0.3)
        return Instead(lambda x: 2.0 * x)

    results = []
    compiled_in_place_of(replaced, find)
    thread = threading.Thread(target=lambda: results.append(CompiledOrPython(second)(2.0)))
    with warnings.catch_warnings():
        warnings.filterwarnings("error", ".*runs as Python")
        assert CompiledOrPython(first)(2.0) == 4.0
        thread.join()
    assert results == [5.0]
