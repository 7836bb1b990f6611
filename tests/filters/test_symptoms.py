"""What innovations show that no Q and R can mend: heavy tails, a stuck channel, estimates that blow up."""

import numpy as np

from filters.consistency.report import HEAVY, STUCK, longest_stretches, sentences
from tests.linear_problem import LinearProblem
from tuning.evaluation.baselines import noise_estimated
from tuning.evaluation.evaluate import check_consistency
from tuning.plants.thruster import find_scenario
from tuning.search.space import oracle_choice


def _said(problem, choice, data):
    return sentences(check_consistency(choice.filter(problem), data))[-1]


def test_outliers_name_the_robust_filter_and_no_constant_to_estimate():
    problem = find_scenario("outliers")
    said = _said(problem, noise_estimated("ekf", problem), problem.data(range(20)))
    assert "ekf-robust" in said and "--gate" in said and "--augment" not in said


def test_a_stuck_channel_is_named_and_a_normal_one_is_not():
    problem = LinearProblem(steps=200)
    data = problem.data(range(4))
    choice = oracle_choice("kf", problem)
    fine = check_consistency(choice.filter(problem), data)
    assert max(fine.repeats) < STUCK and max(fine.tails) < HEAVY
    stuck = data.measurements.copy()
    stuck[0, 60:150, 1] = stuck[0, 59, 1] if np.isfinite(stuck[0, 59, 1]) else 0.3
    said = _said(problem, choice, data._replace(measurements=stuck))
    assert "look at speed [m/s], which has 9" in said and "equal readings in a row" in said


def test_a_stretch_of_equal_readings_is_counted_and_missing_ones_are_not_equal():
    values = np.array([[[1.0], [1.0], [1.0], [np.nan], [np.nan], [2.0]]])
    assert longest_stretches(values).tolist() == [[3]]


def test_the_sample_time_is_no_constant_to_estimate():
    problem = find_scenario("nominal").replace(steps=200)
    report = check_consistency(oracle_choice("ekf", problem).filter(problem), problem.data(range(3)))
    changed = report._replace(constants=("dt", "lift"), whiteness=report.whiteness._replace(p_value=0.0))
    nees = changed.nees._replace(mean=changed.nees.mean._replace(value=9.0, low=8.0, high=10.0))
    said = sentences(changed._replace(nees=nees, tails=()))[-1]
    assert "it has lift)" in said and "dt" not in said
