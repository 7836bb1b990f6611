"""Ensemble sizes of large models: few seeds leave out what will not do, all seeds find what does."""

import numpy as np
import pytest

from tuning.evaluation import sizes
from tuning.evaluation.sizes import FEW, SIZE_TOLERANCE, ensemble_sizes, sufficient_size
from tuning.plants.thruster import find_scenario
from tuning.search import plan as plans
from tuning.search.plan import Plan
from tuning.search.space import Choice

NOMINAL = find_scenario("nominal")


def rows_of(monkeypatch, large, consistent=False, q=1.0, ladder=(5, 8, 40, 80)):
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
    whole, few = (rows_of(monkeypatch, large, consistent) for large in (False, True))
    assert sufficient_size(few, consistent) == sufficient_size(whole, consistent) == 80
    assert [row.seeds for row in whole] == [24] * 4 and [row.seeds for row in few] == [FEW, FEW, 24, 24]
    for one, other in zip(few, whole, strict=True):
        np.testing.assert_array_equal(one.evaluation.mean_squares, other.evaluation.mean_squares[: one.seeds])
    assert few[2].ratio == whole[2].ratio and few[2].outside == whole[2].outside
    assert few[0].ratio.low > 1.0 + SIZE_TOLERANCE


def test_where_no_size_is_consistent_all_count(monkeypatch):
    rows = rows_of(monkeypatch, True, consistent=True, q=100.0, ladder=(5, 80))
    assert all(row.outside > 0 for row in rows) and sufficient_size(rows, consistent=True) == 80
