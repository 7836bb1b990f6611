"""The study on standard errors of identified parameters, in a quick form."""

from dataclasses import replace

import numpy as np
import pytest

from thruster_env.thruster.model import Recorder
from thruster_env.thruster.plant import make_plant
from tuning.experiments.identification import AMPLITUDE, PRESET, SENSORS, TRUTH, coverage, record, report, study
from tuning.likelihood.recorded import likelihood_of
from tuning.plants.thruster_logs import ThrusterFamily
from tuning.problems.problem import Coordinates


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
    with pytest.raises(ValueError, match="repetitions must be a whole number of at least 2, but got 1"):
        study(1)


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
