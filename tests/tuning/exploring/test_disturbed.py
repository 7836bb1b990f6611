"""Disturbances as numbers: data change where they change, and nowhere else."""

import numpy as np
import pytest

from tuning.exploring.bench import Bench
from tuning.exploring.view import disturbances_of, disturbed
from tuning.problems.find import find_problem
from tuning.problems.scenario import plain

SEEDS = range(3)


def values_of(problem):
    return {one.name: value for one, value in disturbances_of(problem).items()}


def test_those_of_a_scenario_are_its_own():
    assert values_of(find_problem("outliers"))["outliers"] == 0.05
    assert values_of(find_problem("outliers"))["outlier_size"] == 20.0  # 10 N of 0.5 N
    assert values_of(find_problem("bias"))["bias"] == 3.0
    assert values_of(find_problem("deadband"))["dead_band"] == 1.0
    assert set(values_of(find_problem("nominal")).values()) == {0.0, 20.0}
    assert "dead_band" not in values_of(find_problem("auv:motion"))


@pytest.mark.parametrize("name", ["outliers", "bias", "deadband", "mixed", "auv:motion"])
def test_unchanged_ones_leave_the_problem_as_it_is(name):
    problem = find_problem(name)
    assert disturbed(problem, values_of(problem)) is problem


def test_a_scenario_without_its_disturbance_is_the_nominal_one():
    nominal, calm = find_problem("nominal"), disturbed(find_problem("outliers"), {"outliers": 0.0})
    assert np.array_equal(calm.data(SEEDS).measurements, nominal.data(SEEDS).measurements)


def test_what_is_added_to_the_nominal_one_makes_the_scenario():
    nominal = find_problem("nominal")
    made = disturbed(nominal, {"outliers": 0.05, "outlier_size": 20.0})
    assert made.name == "nominal (changed)"
    assert plain(made.sensors) == plain(find_problem("outliers").sensors)
    wider = disturbed(nominal, {"dead_band": 1.0})
    assert plain(wider.amplifier) == plain(find_problem("deadband").amplifier)


def test_other_arguments_of_an_effect_stay():
    problem = disturbed(find_problem("mixed"), {"outliers": 0.1, "outlier_size": 40.0})
    outliers, dropout = plain(problem.sensors)["thrust"]
    assert outliers == {"name": "outliers", "std": 20.0, "probability": 0.1}
    assert dropout == {"name": "dropout", "probability": 0.1, "mean_length": 5}


def test_sizes_are_those_of_each_channels_noise():
    problem = disturbed(find_problem("auv:motion"), {"bias": 2.0})
    found = {channel: chain[0]["std"] for channel, chain in plain(problem.sensors).items()}
    assert found["u"] == pytest.approx(0.04) and found["phi"] == pytest.approx(0.01)


def test_a_bench_shows_the_redrawn_data():
    bench = Bench(find_problem("nominal"))
    assert np.isnan(bench.view({"dropout": 0.5}, 2).innovation).mean() == pytest.approx(0.5, abs=0.15)
    assert np.array_equal(bench.view({"outliers": 0.3}, 2).truth, bench.view(seeds=2).truth)
    assert not np.array_equal(bench.view({"dead_band": 2.0}, 2).truth, bench.view(seeds=2).truth)
