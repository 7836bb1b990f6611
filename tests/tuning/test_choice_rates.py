"""How often the choice at the end is wrong, on synthetic runs whose truth is known."""

import numpy as np
import pytest
from scipy.stats import binom

from docs.scripts.tuning_choice import (
    CASES,
    GIVEN,
    TRUTH_CASES,
    case_rates,
    choice_size,
    chosen_by,
    measured_of,
    plan_of,
)
from filters.consistency.nees import Interval
from tests import altitude_problem
from tests.linear_problem import LinearProblem
from tuning.evaluation.baselines import RULE
from tuning.search.measures import Measured, Runs, logs_with_loss, over, signed_rank
from tuning.search.plan import HELD_OUT_SEEDS, VALIDATION_SEEDS, Plan
from tuning.search.space import untuned_choice
from tuning.search.validation import Choosing, Met, _wins

PLAN = Plan("kf", (LinearProblem(),))
CHOICE = untuned_choice("kf", LinearProblem())
STUDIES, LEVEL = 400, 1e-4
OWN = 0.1  # part of a run's squares that filters have not in common
UNIT = 0.5 * OWN * np.sqrt(2.0 / VALIDATION_SEEDS)  # standard error of log(V_1 / V_2), exponential parts


def _squares(levels, runs, generator):
    """Mean squares of filters with such logarithms of their errors, (filters, runs); most of a run is common."""
    common, own = generator.exponential(size=runs), generator.exponential(size=(len(levels), runs))
    return np.exp(2.0 * np.asarray(levels))[:, None] * ((1.0 - OWN) * common + OWN * own)


def _measured(squares):
    rest = (squares.sum() - squares) / (len(squares) - 1)
    runs = Runs(squares[:, None], squares, squares)
    return Measured(np.sqrt(squares.mean()), (np.sqrt(rest),), 0.0, (1.0,), runs=(runs,), decisive=(0,))


def _rates(candidates, baselines):
    """Numbers of studies: a trial taken, one that is significantly worse held out, anything that is.

    Args:
        candidates: logarithms of the trials' errors, in standard errors of a difference on the validation seeds.
        baselines: those of the baselines.
    """
    generator, levels, count = np.random.default_rng(7), UNIT * np.array([*baselines, *candidates]), len(baselines)
    taken = by_trial = by_any = 0
    for _ in range(STUDIES):
        drawn = (_squares(levels, runs, generator) for runs in (VALIDATION_SEEDS, HELD_OUT_SEEDS))
        met, held_out = ([_measured(one) for one in squares] for squares in drawn)
        of = {str(at): one for at, one in enumerate(met)}
        trials = {name: of.pop(name) for name in list(of)[count:]}
        choosing = Choosing(PLAN, of, trials)
        name = next((name for name in choosing.order() if choosing.wins(name)), choosing.baseline)
        wins, chosen = int(name) >= count, held_out[int(name)]
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


def _blocks(*logs):
    """Filters by their differences in blocks of logs, (B,) each, and one with none."""
    values, numbers = np.concatenate(logs), np.repeat(range(len(logs)), [len(one) for one in logs])
    return measured_of(values, False, numbers), measured_of(np.zeros_like(values), False, numbers)


def _choosing(one, other):
    return Choosing(plan_of(False), {GIVEN: other}, {"trial 1": one})


def test_signed_ranks_are_those_of_scipy_and_shared_by_ties():
    from scipy.stats import wilcoxon

    generator = np.random.default_rng(3)
    for shift in (0.0, -0.5, 1.0):
        differences = generator.standard_normal(24) + shift
        found = signed_rank(*_blocks(differences), ratio=False)
        a, b = (one._replace(runs=(one.runs[0]._replace(logs=None),)) for one in _blocks(differences))
        expected = wilcoxon(differences, alternative="less", correction=True, method="approx").pvalue
        assert signed_rank(a, b, ratio=False) == pytest.approx(expected, rel=1e-9) and found >= expected * 0.999
    tied = _blocks(np.array([-1.0, -1.0, 2.0, 0.0]))
    assert signed_rank(*tied, ratio=False) == pytest.approx(float(wilcoxon_by_hand([-2.5, -2.5, 4.0])))
    assert signed_rank(tied[1], tied[1], ratio=False) == 1.0


def wilcoxon_by_hand(ranks):
    from scipy.stats import norm

    return norm.cdf((sum(ranks) + 1.0) / np.sqrt(np.square(ranks).sum()))


def test_one_block_in_which_the_given_filter_fails_does_not_protect_it():
    calm = np.random.default_rng(0).normal(-6.0, 4.0, 16)
    failing = calm.copy()
    failing[11] = -2500.0  # a trial is better by this
    one, other = _blocks(failing[:8], failing[8:])
    assert over(one, other, ratio=False).high > 0.0 > over(one, other, ratio=False).value
    choosing = _choosing(one, other)
    assert choosing.wins("trial 1") and chosen_by(choosing) == "trial 1"
    against = np.abs(calm)
    against[11] = -2500.0  # better in this block alone: the next log may have none
    assert not _choosing(*_blocks(against[:8], against[8:])).wins("trial 1")


def test_what_suits_one_log_alone_is_not_taken():
    noise = np.random.default_rng(1).normal(0.0, 1.0, (2, 12))
    one, other = _blocks(noise[0] + 2.0, noise[1] - 30.0)
    assert over(one, other, ratio=False).high < 0.0  # by the mean it is significantly better
    assert logs_with_loss(one, other, ratio=False) == [(0, 0)] and not _choosing(one, other).wins("trial 1")
    both = _blocks(noise[0] - 2.0, noise[1] - 30.0)
    assert logs_with_loss(*both, ratio=False) == [] and _choosing(*both).wins("trial 1")
    rest = np.concatenate([noise[0] - 3.0, [40.0]])  # better in each block but one
    assert logs_with_loss(*_blocks(rest, noise[1] - 30.0), ratio=False) == []


def test_of_the_worst_problem_alone_runs_are_compared():
    generator = np.random.default_rng(2)
    easy, hard = generator.exponential(size=(2, 30)) + [[0.1], [5.0]]

    def filter_(a, b):
        parts = [measured_of(some, True) for some in (a, b)]
        left_out, runs = (parts[1].left_out[0],) * 2, (*parts[0].runs, *parts[1].runs)
        return Measured(parts[1].value, left_out, 0.0, (1.0,), runs=runs, decisive=(1,))

    one, other = filter_(easy * 4.0, hard * 0.8), filter_(easy, hard)
    assert signed_rank(one, other, ratio=True) < 1e-5
    assert signed_rank(one._replace(decisive=(0, 1)), other, ratio=True) > 0.1


@pytest.mark.parametrize(("heavy", "time"), [(False, 60.0), (True, 240.0)])
def test_dependent_blocks_do_not_pass_for_so_many_independent_ones(heavy, time):
    all_blocks, apart, _, chosen = choice_size(time, heavy, 400)
    most = {60.0: 0.035, 240.0: 0.09}[time]
    assert chosen <= 100.0 / 400 * binom.isf(LEVEL, 400, most) and chosen < all_blocks / 2.0
    assert time < 100.0 or chosen < apart


def test_a_filter_that_fails_in_one_place_is_replaced_and_one_that_is_right_stays():
    rates = case_rates(CASES[7], False, 40)
    assert rates.changed > 75.0 and rates.false_changes <= 100.0 / 40 * binom.isf(LEVEL, 40, 0.01)
    for case, truth in ((CASES[10], False), (TRUTH_CASES[2], True)):
        assert case_rates(case, truth, 40).changed <= 100.0 / 40 * binom.isf(LEVEL, 40, 0.04)


@pytest.mark.parametrize(("gain", "least", "most"), [(0.0, 0.0, 0.06), (1.5, 0.95, 1.0), (-1.5, 0.0, 0.001)])
def test_few_validation_blocks_are_helped_by_training_where_a_baseline_was_not_fitted(gain, least, most):
    generator, studies, taken = np.random.default_rng(11), 200, 0
    for _ in range(studies):
        rule, given = {}, {}
        for part, blocks in (("training", 20), ("validation", 6)):
            rule[part], given[part] = _blocks(generator.standard_normal(blocks) * 3.0 - 3.0 * gain)
        fitted = Choosing(plan_of(False), {GIVEN: given["validation"], RULE: rule["validation"]}, {}, {})
        pair = {GIVEN: given["training"], RULE: rule["training"]}
        choosing = Choosing(plan_of(False), {GIVEN: given["validation"], RULE: rule["validation"]}, {}, pair)
        assert choosing.baseline == RULE or fitted.baseline == GIVEN
        taken += choosing.baseline == RULE
    assert binom.ppf(LEVEL, studies, least) <= taken <= binom.isf(LEVEL, studies, most)
