"""Programs with loops over members: equal to NumPy's, however they are cut."""

import numpy as np
import pytest

from filters.algebra.matrices import entries_product, input_matrix
from filters.algebra.members import covariance, mean, variances
from filters.pages.kernels import Stage, as_programs
from thruster_env.core.compiled import interpreted
from thruster_env.graphs.loops import Loops
from thruster_env.graphs.programs import OF_MEMBERS, Place, callable_of, cut

N, COLUMNS, SIZE = 7, 16, 11


def exchanged(x, y):
    """Two vectors of members in each other's place, less means, and times the variances."""
    return y - mean(x), entries_product(variances(y), x - mean(y)), covariance(x, y)


def spread(x, y):
    """More sums than one loop has, and members that later loops need."""
    d = entries_product(x, y) - y
    return x - covariance(d, x) @ d, entries_product(d, d), covariance(d, y)


def stage_of(page):
    x = input_matrix(Place("table", 0), (N,), member=True)
    y = input_matrix(Place("table", N), (N,), member=True, like=x)
    places = Place("table", 0), Place("table", N), Place("rows", 0)
    return as_programs(Stage(dict(zip(places, page(x, y), strict=True)), {}), 0, 10_000).values


@pytest.mark.parametrize("page", [exchanged, spread])
def test_compiled_loops_and_interpreted_ones_are_numpys(page):
    program = stage_of(page)
    work, parts = callable_of(program, 8, OF_MEMBERS, 2 * N), cut(program, 2 * N)
    assert any(len(turn.bodies) > 1 for turn in parts.turns)

    def once(rows, given, numbers, table, draws, size):
        work(rows, given, numbers, table, draws, size)

    generator = np.random.default_rng(5)
    members = generator.normal(size=(2 * N, SIZE))
    expected = page(members[:N], members[N:])
    for mode in ("compiled", "interpreted"):
        table, rows, nothing = np.full((parts.rows, COLUMNS), np.nan), np.zeros(N * N), np.zeros(0)
        table[: 2 * N, :SIZE] = members  # what lies behind the last member is NaN and counts in no sum
        if mode == "compiled":
            Loops(once)(rows, nothing, nothing, table, nothing, SIZE)
        else:
            with interpreted():
                once(rows, nothing, nothing, table, nothing, SIZE)
        np.testing.assert_allclose(table[:N, :SIZE], expected[0], rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(table[N : 2 * N, :SIZE], expected[1], rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(rows.reshape(N, N), expected[2], rtol=1e-11, atol=1e-13)


def test_what_an_early_loop_overwrites_is_kept_for_a_late_one():
    parts = cut(stage_of(exchanged), 2 * N)
    assert parts.rows > 2 * N
    written = [{place for place, _ in body.stores} for turn in parts.turns for body in turn.bodies]
    assert Place("table", 0) in written[-1]
