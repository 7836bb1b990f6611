"""Functions written out as text, what their tracebacks show, and what their machine code follows from."""

import linecache
import sys
import textwrap
import types

import numpy as np
import pytest
from numba.core.serialize import dumps

from thruster_env.core.compiled import code_text, function_fingerprint, interpreted, is_interpreting
from thruster_env.core.sources import (
    column_reader,
    column_writer,
    matrix_reader,
    matrix_writer,
    scaled_sum,
    vector_reader,
    vector_writer,
    written_out,
)
from thruster_env.graphs.loops import Loops

ROW = np.arange(10.0, 22.0)
TABLE = ROW.reshape(3, 4)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_column_is_read_downwards(count):
    assert column_reader(count)(TABLE, 2) == tuple(TABLE[:count, 2])


@pytest.mark.parametrize("first", [0, 1])
def test_a_column_is_written_where_it_belongs_and_nowhere_else(first):
    table, expected = TABLE.copy(), TABLE.copy()
    expected[first : first + 2, 3] = (-1.0, -2.0)
    assert column_writer(2, first)(table, 3, (-1.0, -2.0)) is None
    np.testing.assert_array_equal(table, expected)


@pytest.mark.parametrize("start", [0, 3])
def test_a_vector_is_read_and_written_from_its_start(start):
    assert vector_reader(4, start)(ROW) == tuple(ROW[start : start + 4])
    row, expected = ROW.copy(), ROW.copy()
    expected[start : start + 2] = (-1.0, -2.0)
    vector_writer(2, start)(row, (-1.0, -2.0))
    np.testing.assert_array_equal(row, expected)


@pytest.mark.parametrize("start", [0, 5])
@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (2, 3), (3, 2)])
def test_a_matrix_is_read_and_written_by_rows(rows, columns, start):
    size = rows * columns
    read = matrix_reader(rows, columns, start)(ROW)
    np.testing.assert_array_equal(read, ROW[start : start + size].reshape(rows, columns))
    row, expected = ROW.copy(), ROW.copy()
    expected[start : start + size] = -np.arange(size)
    matrix_writer(rows, columns, start)(row, tuple(map(tuple, -np.arange(size).reshape(rows, columns))))
    np.testing.assert_array_equal(row, expected)


def test_scaled_sum_is_x_plus_a_y_and_does_not_change_its_arguments():
    x, y = (1.0, 2.0, np.array([3.0, 4.0])), (10.0, 20.0, np.array([30.0, 40.0]))
    a, b, c = scaled_sum(3)(x, 0.5, y)
    assert (a, b) == (6.0, 12.0)
    np.testing.assert_array_equal(c, [18.0, 24.0])
    np.testing.assert_array_equal(x[2], [3.0, 4.0])


def test_written_out_functions_see_the_names_they_were_given():
    plus = written_out("plus", "x", "y = x * factor", "y + 1", factor=3)
    assert plus.__name__ == "plus"
    assert plus(2) == 7


def shuffle(row, table):
    x = scaled_sum_2(read_vector(row), 2.0, read_column(table, 1))
    a = read_matrix(row)
    store_column(table, 0, (a[1][0], a[0][1]))
    store_vector(row, x)
    store_matrix(row, ((x[0], a[1][1]), (a[0][0], x[1])))


scaled_sum_2, read_vector, read_column, read_matrix = (
    scaled_sum(2),
    vector_reader(2, 1),
    column_reader(2),
    matrix_reader(2, 2, 3),
)
store_column, store_vector, store_matrix = column_writer(2, 1), vector_writer(2), matrix_writer(2, 2, 7)


def test_compiled_readers_and_writers_do_what_the_python_ones_do():

    def run(row, table):
        shuffle(row, table)

    expected_row, expected_table = ROW.copy(), TABLE.copy()
    run(expected_row, expected_table)
    row, table = ROW.copy(), TABLE.copy()
    Loops(run)(row, table)
    np.testing.assert_array_equal(row, expected_row)
    np.testing.assert_array_equal(table, expected_table)
    assert (row != ROW).any() and (table != TABLE).any()


def test_nothing_is_compiled_within_interpreted_even_after_an_error():
    def function(x):
        x[0] += 1.0

    with pytest.raises(RuntimeError, match="stop"):
        with interpreted():
            assert is_interpreting()
            assert Loops(function).in_python
            with interpreted():
                pass
            assert Loops(function).in_python
            raise RuntimeError("stop")
    assert not is_interpreting() and not Loops(function).in_python


def test_a_fingerprint_tells_functions_apart_and_is_stable():
    def one(x):
        return x + 1.0

    def other(x):
        return x + 2.0

    assert function_fingerprint(one) == function_fingerprint(one)
    assert len({function_fingerprint(*each) for each in ((), (one,), (other,))}) == 3


def shifted(size, by):
    """A function whose text depends on more than the sizes in its name."""
    return written_out("shift", "x", f"x + {by:.1f}")


def key(function):
    """What numba compares of a function in a closure to find its machine code again."""
    return dumps((function,))


def test_machine_code_is_found_again_whatever_was_written_out_before(monkeypatch):
    first, other = key(shifted(2, 1.0)), key(shifted(2, 2.0))
    assert first != other
    monkeypatch.setattr(linecache, "cache", {})  # as in another process
    assert key(shifted(2, 2.0)) == other and key(shifted(2, 1.0)) == first


def test_the_source_of_each_of_equal_names_is_shown():
    for function, text in ((shifted(2, 1.0), "x + 1.0"), (shifted(2, 2.0), "x + 2.0")):
        file = function.__code__.co_filename
        assert linecache.getlines(file) == ["def shift(x):\n", f"    return {text}\n"]
        assert file.startswith("<shift, written out by tests.thruster_env.core.test_sources.shifted(2), ")


USERS = """
import params
from params import K
from params import TABLE

def direct(x):
    return K * x

def attribute(x):
    return params.K * x

def nested(x):
    def inner(y):
        return params.deeper.K * y
    return inner(x)

def listed(x):
    return TABLE[0] * x

def made(k):
    def closed(x):
        return k * x
    return closed

def outer(x):
    return direct(x)
"""


def users(monkeypatch, k):
    """A user's file, the numbers of which are in another file of his."""
    params = types.ModuleType("params")
    params.deeper = types.ModuleType("params.deeper")
    params.K, params.deeper.K, params.TABLE, params.other = k, k, np.array([k, 1.0]), object()
    monkeypatch.setitem(sys.modules, "params", params)
    found = types.ModuleType("mine")
    exec(compile(textwrap.dedent(USERS), "mine.py", "exec"), found.__dict__)
    found.closed = found.made(k)
    return found


@pytest.mark.parametrize("name", ["direct", "attribute", "nested", "listed", "closed", "outer"])
def test_another_number_in_another_file_is_another_code(monkeypatch, name):
    one, same, other = (getattr(users(monkeypatch, k), name) for k in (2.0, 2.0, 3.0))
    prints = [function_fingerprint(part) for part in (one, same, other)]
    assert prints[0] == prints[1] != prints[2]


def test_objects_tell_nothing_for_their_addresses_differ(monkeypatch):
    assert "object at" not in code_text(users(monkeypatch, 2.0).attribute)
