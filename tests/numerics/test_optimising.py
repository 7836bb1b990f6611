"""Functions that only compiled code can call: no machine code of their own, and the same numbers and errors."""

import gc

import numpy as np
import pytest
from numba.core import codegen

from numerics.compiled import compiled, inlined, kept_apart


@kept_apart
def total(values):
    result = 0.0
    for i in range(values.shape[0]):
        result += values[i]
    return result


@inlined
def checked_total(values):
    if values.shape[0] == 0:
        raise ValueError("values must not be empty")
    return total(values)


@pytest.fixture
def emissions(monkeypatch):
    """Whether garbage was collected, for each library of which machine code is made."""
    found, emit = [], codegen.JITCodeLibrary._finalize_specific

    def watched(self):
        if self.name != "nrt":  # of numba's own
            found.append(gc.isenabled())
        emit(self)

    monkeypatch.setattr(codegen.JITCodeLibrary, "_finalize_specific", watched)
    return found


@pytest.fixture
def outermost(tmp_path):
    """A function that no cache has seen."""
    path = tmp_path / "outermost.py"
    path.write_text("def outermost(values):\n    return checked_total(values) + total(values[1:])\n")
    names = {"__name__": __name__, "checked_total": checked_total, "total": total}
    exec(compile(path.read_text(), str(path), "exec"), names)
    return compiled(names["outermost"])


def test_machine_code_is_made_once_without_collecting_garbage(outermost, emissions):
    assert gc.isenabled()
    assert outermost(np.arange(5.0)) == 20.0
    assert emissions == [False]
    assert gc.isenabled()


def test_an_error_within_what_is_called_reaches_the_caller(outermost):
    with pytest.raises(ValueError, match="values must not be empty"):
        outermost(np.zeros(0))


def test_a_function_that_is_kept_apart_is_called(outermost):
    outermost(np.arange(5.0))
    (text,) = outermost.inspect_llvm().values()
    calls = [line.split("@")[1] for line in text.splitlines() if " call " in line and "@" in line]
    assert any("5total" in name for name in calls)
    assert not any("13checked_total" in name for name in calls)
