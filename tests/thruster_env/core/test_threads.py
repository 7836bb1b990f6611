"""Work spread over threads: all of it done once, whatever goes wrong."""

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from importlib import import_module

import numpy as np
import pytest

from thruster_env.core.parallel import spread

COUNT = 1000


def add_index(first, last, values):
    for i in range(first, last):
        values[i] += i


def test_spread_covers_everything_once():
    values = np.zeros(COUNT)
    spread(lambda first, last: add_index(first, last, values), COUNT)
    assert np.array_equal(values, np.arange(COUNT))


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_after_an_exception_no_further_part_of_spread_begins(error, monkeypatch):
    pool, begun, raised = ThreadPoolExecutor(2), [], threading.Event()
    monkeypatch.setattr("thruster_env.core.parallel._pool", lambda: pool)
    monkeypatch.setattr("thruster_env.core.parallel.cores", lambda: 50)

    def fail(*_):
        raised.set()
        raise error

    def part(first, last):
        begun.append(first)
        if first == 0 < last and error is ValueError:
            fail()
        if last:
            raised.wait(10)  # a guard, not a measurement
            time.sleep(0.01)  # what was raised gets to the caller

    if error is KeyboardInterrupt:  # it comes to the caller, while that waits
        monkeypatch.setattr(Future, "result", fail)
    with pytest.raises(error):
        spread(part, 200)
    pool.shutdown()
    assert len(begun) < 100


def test_a_part_may_spread_work_itself():
    found = np.zeros((40, 30))

    def row(i):
        def cells(first, last):
            found[i, first:last] += 1.0

        return cells

    def rows(first, last):
        for i in range(first, last):
            spread(row(i), 30)

    calling = threading.Thread(target=spread, args=(rows, 40), daemon=True)  # it once waited for ever
    calling.start()
    calling.join(timeout=20.0)
    assert not calling.is_alive() and (found == 1.0).all()


def test_work_that_is_spread_while_a_module_is_imported_may_import_it(tmp_path, monkeypatch):
    # A worker that loads compiled code of a model imports the model's module: it would wait for the end of
    # an import that waits for the worker.
    source = """
from importlib import import_module
from thruster_env.core.parallel import spread
found = []
def part(first, last):
    if not found:
        found.append(import_module(__name__))
spread(part, 8)
"""
    (tmp_path / "spreads_at_import.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    importing = threading.Thread(target=import_module, args=("spreads_at_import",), daemon=True)
    importing.start()
    importing.join(60.0)  # a guard, not a measurement
    assert not importing.is_alive()
    assert import_module("spreads_at_import").found
