"""Functions that only compiled code can call: no machine code of their own, and the same numbers and errors."""

import ctypes
import gc
import pickle
import threading
import time

import numba
import numpy as np
import pytest
from numba.core import codegen, event
from numba.extending import overload

from thruster_env.core.compiled import compiled, inlined, not_inlined
from thruster_env.core.optimising import RARELY


@not_inlined
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
    """Whether garbage was collected as ever, for each library of which machine code is made."""
    found, emit = [], codegen.JITCodeLibrary._finalize_specific

    def watched(self):
        if self.name != "nrt":  # of numba's own
            found.append((self.name, gc.get_threshold()[0] < RARELY))
        emit(self)

    monkeypatch.setattr(codegen.JITCodeLibrary, "_finalize_specific", watched)
    return found


def unseen(tmp_path, value, **names):
    """A compiled function outermost(x) that no cache has seen, which returns a value."""
    path = tmp_path / "outermost.py"
    path.write_text(f"def outermost(x):\n    return {value}\n")
    names |= {"__name__": __name__}
    exec(compile(path.read_text(), str(path), "exec"), names)
    return compiled(names["outermost"])


@pytest.fixture
def outermost(tmp_path):
    return unseen(tmp_path, "checked_total(x) + total(x[1:])", checked_total=checked_total, total=total)


def test_machine_code_is_made_once_and_garbage_seldom_collected(outermost, emissions):
    before = gc.get_threshold()
    assert outermost(np.arange(5.0)) == 20.0
    assert emissions == [("outermost", False)]
    assert gc.isenabled() and gc.get_threshold() == before


def test_an_error_within_what_is_called_reaches_the_caller(outermost):
    with pytest.raises(ValueError, match="values must not be empty"):
        outermost(np.zeros(0))


def calls_in(function):
    """Names of the functions that machine code calls."""
    (text,) = function.inspect_llvm().values()
    return [line.split("@")[1] for line in text.splitlines() if " call " in line and "@" in line]


def test_a_function_that_is_kept_apart_is_called(outermost):
    outermost(np.arange(5.0))
    calls = calls_in(outermost)
    assert any("5total" in name for name in calls)
    assert not any("13checked_total" in name for name in calls)


@inlined
def twice(x):
    return 2.0 * x


@not_inlined
def ice(x):  # part of the name of what it calls, which is inlined all the same
    return twice(x) + 1.0


def test_a_function_that_is_kept_apart_contains_what_it_calls(tmp_path):
    outermost = unseen(tmp_path, "ice(x) + ice(x + 1.0)", ice=ice)
    assert outermost(1.0) == 8.0
    calls = calls_in(outermost)
    assert any("3ice" in name for name in calls) and not any("5twice" in name for name in calls)


def test_a_refusal_leaves_garbage_collection_as_it_was():
    before = gc.get_threshold()
    refused = compiled(lambda x: total(x) + object())
    with pytest.raises(numba.TypingError):
        refused(np.zeros(3))
    assert gc.get_threshold() == before
    assert compiled(lambda x: total(x) + 1.0)(np.ones(3)) == 4.0


def test_a_listener_that_fails_leaves_garbage_collection_as_it_was(outermost):
    class Failing(event.Listener):
        def on_start(self, event):
            raise KeyboardInterrupt

        def on_end(self, event):
            pass

    before = gc.get_threshold()
    with event.install_listener("numba:compile", Failing()), pytest.raises(KeyboardInterrupt):
        outermost(np.ones(3))
    assert gc.get_threshold() == before
    assert outermost(np.arange(5.0)) == 20.0


def test_a_threshold_that_somebody_sets_meanwhile_stays():
    def told(x):
        return x

    @overload(told)
    def told_in_machine_code(x):
        gc.set_threshold(800, 11, 12)
        return lambda x: x

    before, ever_new = gc.get_threshold(), float(time.time_ns())  # so that no machine code is found in the cache
    try:
        assert compiled(lambda x: total(x) + told(x[0]) + 0.0 * ever_new)(np.ones(3)) == 4.0
        assert gc.get_threshold() == (800, 11, 12)
    finally:
        gc.set_threshold(*before)


def test_threads_compile_at_the_same_time():
    before, found = gc.get_threshold(), {}

    def run(i):
        ours = compiled(lambda x: total(x) + i) if i % 2 else numba.njit(lambda x: x.sum() + i)
        found[i] = ours(np.ones(4))

    threads = [threading.Thread(target=run, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {i: 4.0 + i for i in range(4)}
    assert gc.get_threshold() == before


def test_functions_of_others_are_made_as_ever(outermost, emissions):
    outermost(np.ones(3))  # ours first, so that what both use is there
    emissions.clear()

    def half(x):
        return 0.5 * x

    overload(half)(lambda x: half)
    own = numba.njit(lambda x: half(x) + 1.0)
    assert own(3.0) == 2.5
    assert [collecting for _, collecting in emissions] == [True, True]  # of the overload, too

    by_address = numba.cfunc("float64(float64)")(half)
    assert ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double)(by_address.address)(3.0) == 1.5
    given = numba.njit(lambda function, x: function(x))
    assert given(own, 3.0) == 2.5 and given(by_address, 3.0) == 1.5
    assert pickle.loads(pickle.dumps(own))(3.0) == 2.5
    assert numba.vectorize(lambda x: half(x))(np.ones(2)).tolist() == [0.5, 0.5]


def test_functions_of_others_within_ours_can_be_called_by_themselves(emissions):
    theirs = numba.njit(lambda x: x.sum() + 1.0)
    ufunc = numba.vectorize(lambda x: 2.0 * x)

    def both(x):
        return theirs(x) + total(ufunc(x))

    assert compiled(inlined(both))(np.ones(3)) == 10.0
    assert theirs(np.ones(3)) == 4.0 and ufunc(np.ones(2)).tolist() == [2.0, 2.0]
    assert "both" in str(emissions) and len(theirs.overloads) == 1


def test_a_function_of_others_that_calls_ours_is_kept_and_found_again(tmp_path, monkeypatch):
    path = tmp_path / "theirs.py"
    path.write_text("import numba\n@numba.njit(cache=True)\ndef theirs(values):\n    return total(values) + 1.0\n")
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    hits = []
    for _ in range(2):
        names = {"__name__": "theirs", "total": total}
        exec(compile(path.read_text(), str(path), "exec"), names)
        assert names["theirs"](np.ones(3)) == 4.0
        hits.append(sum(names["theirs"].stats.cache_hits.values()))
    assert hits == [0, 1]
