"""The smallest sufficient ensemble: on seeds of its own, by the end of an interval; few seeds leave some out."""

import numpy as np
import pytest

from filters.consistency.nees import Interval
from tuning.evaluation import sizes
from tuning.evaluation.evaluate import evaluate
from tuning.evaluation.sizes import FEW, SIZE_TOLERANCE, SizeRow, ensemble_sizes, left_out, sufficient_size
from tuning.plants.thruster import find_scenario
from tuning.problems.data import size_seeds
from tuning.search import plan as plans
from tuning.search.plan import SIZE_SEEDS, Plan
from tuning.search.space import Choice, untuned_choice

MISMATCH = find_scenario("mismatch")


def rows_of(intervals, outside=(0.0,) * 9):
    found = zip((5, 10, 20, 50), intervals, outside, strict=False)
    return [SizeRow(n, None, Interval(*ratio), out) for n, ratio, out in found]


@pytest.mark.parametrize(
    ("intervals", "size"),
    [
        ([(1.02, 1.015, 1.025), (1.009, 1.006, 1.012), (1.004, 1.001, 1.007), (1.0, 1.0, 1.0)], 20),
        ([(1.009, 1.008, 1.0099), (1.0, 1.0, 1.0)], 5),
        ([(1.0, 0.9, 1.01), (1.0, 1.0, 1.0)], 10),  # below 1.01, not at it
    ],
)
def test_an_estimate_below_1_01_is_not_enough_where_its_interval_reaches_beyond(intervals, size):
    assert sufficient_size(rows_of(intervals)) == size


@pytest.mark.parametrize(
    ("ends", "size"),
    [((1.2, 1.009, 1.0), 10), ((1.3, 1.06, 1.05), 10), ((1.0, 1.1, 1.1), 5), ((1.015, 1.006), 10)],
)
def test_the_smallest_size_that_suffices_need_not_be_the_best_on_every_scenario(ends, size):
    assert sufficient_size(rows_of([(end, end, end) for end in ends])) == size


def test_the_table_is_of_those_seeds_and_paired(monkeypatch):
    monkeypatch.setattr(sizes, "size_ladder", lambda name: (5, 40))
    plan, choice = Plan("enkf", (MISMATCH,)), untuned_choice("enkf", MISMATCH)
    rows = ensemble_sizes(choice, plan, plan.training_data())
    data = MISMATCH.data(size_seeds(0, SIZE_SEEDS))
    found = [evaluate(choice.with_size(n).filter(MISMATCH), data, MISMATCH.scale) for n in (5, 30, 40)]
    assert [row.size for row in rows] == [5, 30, 40]
    np.testing.assert_array_equal(rows[0].evaluation.mean_squares, found[0].mean_squares)
    best = min(one.score.value for one in found)
    assert [row.ratio.value for row in rows] == [one.score.value / best for one in found]
    assert min(row.ratio.high for row in rows) == 1.0 and 1.01 < rows[0].ratio.low < rows[0].ratio.high
    assert all(row.outside > 0 for row in rows)  # the rule of thumb's Q is far too large


def test_where_it_has_to_be_consistent_the_best_is_that_of_the_consistent_sizes(monkeypatch):
    monkeypatch.setattr(sizes, "size_ladder", lambda name: (5, 40))

    def outside(choice, plan, data):
        return -1.0 if choice.numbers["ensemble_size"] < 40 else 1.0

    monkeypatch.setattr(sizes, "_outside", outside)
    plan, choice = Plan("enkf", (MISMATCH,)), untuned_choice("enkf", MISMATCH)
    free, held = (ensemble_sizes(choice, plan, plan.training_data(), consistent) for consistent in (False, True))
    assert free[2].ratio.value == 1.0 < free[1].ratio.value
    assert held[1].ratio == (1.0, 1.0, 1.0) and held[2].ratio.value < 1.0
    assert sufficient_size(held, consistent=True) == 30


def test_sizes_left_out_by_their_nis_are_told_and_count_again_where_leaving_them_out_costs_too_much():
    def rows(*found):
        return [SizeRow(n, None, Interval(ratio, ratio, ratio), outside) for n, ratio, outside in found]

    cheap = rows((5, 1.3, 0.1), (20, 1.0, -0.1), (200, 0.97, 0.2))
    assert sufficient_size(cheap, consistent=True) == 20 and left_out(cheap, 20) == [5, 200]
    dear = rows((5, 1.4, 0.1), (20, 1.066, -0.1), (200, 1.0, 0.2))
    assert sufficient_size(dear, consistent=True) == 200 and left_out(dear, 200) == []


NOMINAL = find_scenario("nominal")


def rows_on(monkeypatch, large, consistent=False, q=1.0, ladder=(5, 8, 40, 80)):
    monkeypatch.setattr(plans, "SIZE_SEEDS", 24)
    monkeypatch.setattr(plans, "TRAINING_SEEDS", 4)
    monkeypatch.setattr(sizes, "size_ladder", lambda name: ladder)
    monkeypatch.setattr(sizes, "ALL_UP_TO", 0 if large else 12)
    true = NOMINAL.true
    model = {**true, "process_noise_cov": tuple(q * v for v in true["process_noise_cov"])}
    plan, choice = Plan("enkf", (NOMINAL,)), Choice("enkf", model, {"ensemble_size": 40, "inflation": 1.0})
    return ensemble_sizes(choice, plan, plan.training_data(), consistent)


@pytest.mark.parametrize("consistent", [False, True])
def test_the_sufficient_size_is_that_of_all_sizes_on_all_seeds(monkeypatch, consistent):
    whole, few = (rows_on(monkeypatch, large, consistent) for large in (False, True))
    assert sufficient_size(few, consistent) == sufficient_size(whole, consistent) == 80
    assert [row.seeds for row in whole] == [24] * 4 and [row.seeds for row in few] == [FEW, FEW, 24, 24]
    for one, other in zip(few, whole, strict=True):
        np.testing.assert_array_equal(one.evaluation.mean_squares, other.evaluation.mean_squares[: one.seeds])
    assert few[2].ratio == whole[2].ratio and few[2].outside == whole[2].outside
    assert few[0].ratio.low > 1.0 + SIZE_TOLERANCE


def test_where_no_size_is_consistent_all_count(monkeypatch):
    rows = rows_on(monkeypatch, True, consistent=True, q=100.0, ladder=(5, 80))
    assert all(row.outside > 0 for row in rows) and sufficient_size(rows, consistent=True) == 80
