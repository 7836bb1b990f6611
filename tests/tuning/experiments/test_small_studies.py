"""Delays of alarms and standard errors of identified parameters, in the quick forms of their studies."""

import math
from dataclasses import replace

import numpy as np
import pytest

from filters.monitoring import cusum_threshold
from tests.filters.checks import refused
from thruster_env.thruster.model import Recorder
from thruster_env.thruster.plant import make_plant
from tuning.experiments.faults import BIASES, LOST_BLADES, PLANTS, best_delay, delays
from tuning.experiments.identification import AMPLITUDE, PRESET, SENSORS, TRUTH, coverage, record, report, study
from tuning.likelihood.recorded import likelihood_of
from tuning.plants.thruster_logs import ThrusterFamily
from tuning.problems.problem import Coordinates


def test_larger_faults_of_the_thruster_are_found_sooner_and_none_without_one():
    found = delays(PLANTS[0], runs=12)
    steps = [found[f"bias of {size:g} sigma"].median for size in BIASES]
    assert steps == sorted(steps, reverse=True) and steps[-1] <= 3
    assert found["none"].found <= 1 / 12 and found["stuck"].found == 1.0 and found[LOST_BLADES].found == 1.0
    assert found["noise doubled"].first == "variance" and math.isfinite(found["stuck"].median)


def test_the_best_delay_is_that_of_simulated_cusums():
    rng, shift = np.random.default_rng(0), 1.5
    h, total = cusum_threshold(1000.0, 0.5 * shift, sides=1), 0
    for _ in range(4000):
        g, steps = 0.0, 0
        while g < h:
            g, steps = max(0.0, g + shift + rng.standard_normal() - 0.5 * shift), steps + 1
        total += steps
    assert best_delay(shift, 1000.0) == pytest.approx(total / 4000, rel=0.04)


@pytest.mark.slow
def test_estimates_lie_within_their_standard_errors_of_the_truth():
    found = study(3, starts=1, runs=3, steps=250)
    rows = coverage(found)
    assert [one.name for one in rows] == list(TRUTH)
    assert sum(one.within for one in rows) >= 0.85 * 3 * len(rows)
    for one in rows:
        distances = [abs(f.values[one.name] - one.truth) / f.standard_errors[one.name] for f in found]
        assert max(distances) < 5, one.name
        assert np.isclose(one.mean, np.mean([f.values[one.name] for f in found]))
    text = report(rows, 3)
    assert text.count("\n| ") == 1 + len(rows) and "hold the truth" in text


def test_one_repetition_is_refused():
    refused("repetitions must be a whole number of at least 2, but got 1", study, 1)


def test_a_clock_that_is_ahead_is_found_where_it_is_and_not_where_interpolation_hides_noise():
    late = []
    for log in record(0, 3, 250):
        rows = log.measurements.copy()
        rows[2:, 1], rows[:2, 1] = log.measurements[:-2, 1], np.nan  # the speed, two rows late
        late.append(replace(log, measurements=rows))
    plant = make_plant(PRESET, sensors=SENSORS, max_voltage=AMPLITUDE)
    names = [name for name in TRUTH if name not in ("Q11", "Q22", "R11", "R22")]
    family = ThrusterFamily(late, plant, Recorder(), (*names, "clock_offset_speed"))
    objective = likelihood_of(family.data, family.model, Coordinates(family.free))

    def value(offset):
        return objective.value(objective.coordinates.start({**TRUTH, "clock_offset_speed": offset}))

    values = [value(offset) for offset in (0.01, 0.015, 0.018, 0.02, 0.022, 0.025, 0.03)]
    assert np.argmax(values) == 3
    assert family.data.noise_factors(clock_offset_speed=0.015) == {"speed": pytest.approx(0.5)}
    assert family.data.noise_factors(clock_offset_speed=0.02) == {"speed": pytest.approx(1.0)}
    assert np.isnan(family.data(clock_offset_speed=0.02)[0].measurements[1::2, 1]).all()
