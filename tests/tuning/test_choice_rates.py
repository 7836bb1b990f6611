"""How often the choice at the end is wrong, on synthetic runs whose truth is known."""

import numpy as np
import pytest
from scipy.stats import binom

from filters.consistency.intervals import Interval
from tests import altitude_problem
from tests.linear_problem import LinearProblem
from tuning.search.measures import Measured, over
from tuning.search.plan import HELD_OUT_SEEDS, VALIDATION_SEEDS, Plan
from tuning.search.space import untuned_choice
from tuning.search.validation import Met, _best_of, _wins

PLAN = Plan("kf", (LinearProblem(),))
CHOICE = untuned_choice("kf", LinearProblem())
STUDIES, LEVEL = 600, 1e-4
OWN = 0.1  # part of a run's squares that filters have not in common
UNIT = 0.5 * OWN * np.sqrt(2.0 / VALIDATION_SEEDS)  # standard error of log(V_1 / V_2), exponential parts


def _squares(levels, runs, generator):
    """Mean squares of filters with such logarithms of their errors, (filters, runs); most of a run is common."""
    common, own = generator.exponential(size=runs), generator.exponential(size=(len(levels), runs))
    return np.exp(2.0 * np.asarray(levels))[:, None] * ((1.0 - OWN) * common + OWN * own)


def _measured(squares):
    rest = (squares.sum() - squares) / (len(squares) - 1)
    return Measured(np.sqrt(squares.mean()), (np.sqrt(rest),), 0.0, (1.0,))


def _rates(candidates, baselines):
    """Numbers of studies: a trial taken, one that is significantly worse held out, anything that is.

    Args:
        candidates: logarithms of the trials' errors, in standard errors of a difference on the validation seeds.
        baselines: those of the baselines.
    """
    generator, levels, count = np.random.default_rng(7), UNIT * np.array([*baselines, *candidates]), len(baselines)
    taken = by_trial = by_any = 0
    for _ in range(STUDIES):
        met, held_out = (
            [_measured(one) for one in _squares(levels, runs, generator)]
            for runs in (VALIDATION_SEEDS, HELD_OUT_SEEDS)
        )
        baseline = min(range(count), key=lambda at: met[at].value)
        best, _ = _best_of(PLAN, {str(at): met[at] for at in range(count, len(met))}, True)
        told = (
            Met("", CHOICE, met[at].value, over(met[at], met[baseline], ratio=True), 0.0, 1.0, True)
            for at in (int(best), baseline)
        )
        wins = _wins(*told, PLAN, True)
        chosen = held_out[int(best) if wins else baseline]
        worse = any(over(chosen, held_out[at], ratio=True).low > 1.0 for at in range(count))
        taken, by_trial, by_any = taken + wins, by_trial + (wins and worse), by_any + worse
    return taken, by_trial, by_any


@pytest.mark.parametrize("number", (1, 12))
@pytest.mark.parametrize("worse", (0.0, 0.5, 1.0))
def test_a_trial_that_is_taken_is_significantly_worse_held_out_in_less_than_one_per_cent_of_studies(number, worse):
    _, by_trial, _ = _rates([worse] * number, [0.0])
    assert by_trial <= binom.isf(LEVEL, STUDIES, 0.01)


def test_a_trial_that_is_better_is_taken_also_where_six_meet():
    taken, *_ = _rates([-2.0] * 6, [0.0])
    assert taken >= binom.ppf(LEVEL, STUDIES, 0.8)  # an interval widened for six trials takes 0.59 of them


@pytest.mark.parametrize("baselines", ([0.0] * 4, [0.0, 1.5, 1.5, 1.5], [0.0, 2.5, 5.0, 8.0]))
def test_of_four_baselines_that_hardly_differ_the_wrong_one_is_told_in_at_most_ten_per_cent(baselines):
    *_, by_any = _rates([0.5] * 6, baselines)
    assert by_any <= binom.isf(LEVEL, STUDIES, 0.1)


def _met(over_baseline, consistent=True, name="trial 1"):
    return Met(name, CHOICE, 1.0, Interval(*over_baseline), 0.0, 1.0, consistent)


def test_parameters_of_the_users_own_give_way_to_a_noise_that_they_cannot_give():
    plan = Plan("ekf", (altitude_problem.problem(),))
    slightly = _met((1.001, 0.999, 1.003))
    for name in ("noise estimation", "scaled default", "given"):
        assert not _wins(slightly, _met((1.0, 1.0, 1.0), name=name), plan, True)


def test_consistency_alone_wins_only_where_nothing_can_be_lost():
    wrong = _met((1.0, 1.0, 1.0), consistent=False)
    assert _wins(_met((1.00001, 0.99998, 1.00004)), wrong, PLAN, True)
    assert not _wins(_met((1.00001, 0.999, 1.001)), wrong, PLAN, True)
    assert not _wins(_met((1.00001, 0.99998, 1.00004), consistent=False), wrong, PLAN, True)
    assert not _wins(_met((1.00001, 0.99998, 1.00004)), wrong, PLAN._replace(consistent=False), True)
