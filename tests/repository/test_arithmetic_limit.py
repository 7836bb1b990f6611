from collections import Counter

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers BowThruster-v0
from benchmarks import rates
from benchmarks.rates import (
    ADD,
    DIVIDE,
    INTEGER,
    MULTIPLY,
    PRODUCT,
    RECIPROCAL_ROOT,
    ROOT,
    counting,
    normals,
    operations_of,
    step_by_size,
    step_of_env,
    step_of_filter,
    step_of_members,
    times,
)
from filters import make_filter, thruster_model
from thruster_env.core import matrices
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import FILTER_PROCESS, normal_block
from thruster_env.thruster.dynamics import substep
from thruster_env.thruster.plant import make_plant


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda x: (x[0] * x[1] + 3.0, x[0] - x[1]), {MULTIPLY: 1, ADD: 2}),
        (lambda x: (x[0] - x[1], x[1] - x[0]), {ADD: 2}),
        (lambda x: (x[0] * x[1] + x[1] * x[0],), {MULTIPLY: 1, ADD: 1}),  # one product, found twice
        (lambda x: ((x[0] / x[1], x[0])[1], 2.0 * 3.0), {}),  # dropped, or known before
        (lambda x: (1.0 * x[0] + 0.0, -abs(x[1])), {}),
        (lambda x: (x[0] / 3.0, 3.0 / x[0]), {MULTIPLY: 1, DIVIDE: 1}),
        (lambda x: (1.0 / x[0] ** 0.5, x[1] ** -0.5), {RECIPROCAL_ROOT: 2}),
        (lambda x: (x[0] ** 0.5, x[1] / x[0] ** 0.5), {ROOT: 1, DIVIDE: 1}),
        (lambda x: (x[0] if x[0] > x[1] else x[1] + 1.0,), {ADD: 1}),
    ],
)
def test_operations_on_which_a_result_depends_are_counted_once(function, expected):
    assert operations_of(function, np.array([1.5, 2.5])) == expected


def test_operations_of_matrices_and_of_whole_numbers_are_counted():
    with counting() as graph:
        a, b, words = (graph.variables(given) for given in (np.ones((7, 8)), np.ones((8, 9)), np.arange(2)))
        made = matrices.product(a, b)
        mixed = np.array([(words[0] * words[1] >> 32) ^ words[0]], dtype=object)
    assert graph.operations(made) == {MULTIPLY: 7 * 8 * 9, ADD: 7 * 7 * 9}
    assert graph.operations(mixed) == {PRODUCT: 1, INTEGER: 2}


def test_numbers_that_are_counted_have_their_values():
    constants, x = make_plant().constants, (30.0, 1.0)
    with counting() as graph:
        moved = substep(tuple(graph.variables(np.array(x))), (12.0, 0.0), constants)
        block = normal_block(*graph.variables(np.arange(2)), FILTER_PROCESS, 2, 3)
    np.testing.assert_allclose([number.value for number in moved], substep(x, (12.0, 0.0), constants), rtol=1e-15)
    with interpreted():
        np.testing.assert_allclose([number.value for number in block], normal_block(0, 1, FILTER_PROCESS, 2, 3))


def test_an_env_draws_the_normals_that_it_uses():
    count = step_of_env(gym.make("BowThruster-v0"))
    assert count[ROOT] == count[DIVIDE] == 2  # two of the process from one pair, one of the measurement
    assert normals(8)[ROOT] == normals(8)[DIVIDE] == 4
    plant = make_plant()
    motion = operations_of(substep, np.zeros(2), (12.0, 0.0), plant.constants)
    assert motion[RECIPROCAL_ROOT] == 4 and count[RECIPROCAL_ROOT] == 4 * plant.substeps + 1  # and the thrust


def test_operations_of_an_ensemble_lie_on_a_line_over_its_size():
    filter_ = make_filter("enkf", thruster_model(), ensemble_size=32)
    fixed, a_member = step_by_size(filter_)
    assert step_of_filter(filter_) == fixed + times(a_member, 32)
    assert step_of_filter(filter_) == pytest.approx(step_of_members(filter_, 32), rel=0.02)
    assert a_member[RECIPROCAL_ROOT] == 4 * filter_.model.substeps + 1 and a_member[ROOT] == 1.5


def test_the_limit_takes_additions_and_multiplications_in_pairs(monkeypatch):
    seconds = dict.fromkeys(rates.LOOPS, 1.0) | {rates.FUSED: 0.5, rates.ROUND: 4.0, RECIPROCAL_ROOT: 16.0}
    monkeypatch.setattr(rates, "rates", lambda cores: {kind: rate / cores for kind, rate in seconds.items()})
    assert rates.arithmetic_limit(Counter({ADD: 3, MULTIPLY: 6})) == 3.0
    count = Counter({ADD: 8, DIVIDE: 1, RECIPROCAL_ROOT: 2, PRODUCT: 3, INTEGER: 10})
    assert rates.arithmetic_limit(count, cores=2) == 0.5 * (4.0 + 1.0 + 32.0 + 12.0 + 1.0)


@pytest.mark.parametrize("kind", rates.LOOPS)
def test_loops_of_the_rates_do_as_many_operations_as_they_say(kind):
    for loop in rates.LOOPS[kind]:
        with counting() as graph:
            data = graph.variables(loop.data[5:6])
            loop.function(data, 1)
        count = graph.operations(data)
        found = {rates.FUSED: max(count[ADD], count[MULTIPLY]), rates.ROUND: count[PRODUCT]}.get(kind, count[kind])
        if kind == RECIPROCAL_ROOT:
            assert data[0].value == pytest.approx((loop.data[5] + 1.0) ** -0.5, rel=1e-15)
        else:
            assert found == loop.count
