"""Effects that are not there: nested models contain their null, and each parameter is tested against it."""

import math

import numpy as np
import pytest

from tests.filters.test_sensitivity import pendulum
from tests.tuning.test_identify import FREE, TRUTH, recorded
from tests.tuning.test_identify_starts import NOISE, OWN, PRESET, thruster_logs
from thruster_env.thruster.model import Recorder
from thruster_env.thruster.plant import make_plant
from tuning.likelihood.identify import identify
from tuning.likelihood.objective import kept_variance, lost_information
from tuning.likelihood.result import NullTest
from tuning.plants.thruster_logs import ThrusterFamily
from tuning.problems.problem import Parameter

EFFECTS = (
    "lag_speed",
    "lag_thrust",
    "dead_band_low",
    "dead_band_high",
    "bias_thrust",
    "bias_speed",
    "thrust_asymmetry",
    "ambient_velocity",
)


def with_effects(logs, effects, **options):
    plant = make_plant(PRESET, sensors=("thrust", "speed"), max_voltage=12.0)
    family = ThrusterFamily(logs, plant, Recorder(), (*OWN[:2], *effects))
    return identify(family.data, family.model, family.free, starts=1, **options)


@pytest.mark.slow
def test_effects_that_are_not_there_lower_no_likelihood_and_bias_nothing():
    logs = thruster_logs(speeds=(None,) * 3, steps=300)
    plain = with_effects(logs, (), against=False)
    found = with_effects(logs, EFFECTS)
    assert found.log_likelihood >= plain.log_likelihood - 1e-3
    assert (
        found.log_likelihood < plain.log_likelihood + 15.0
    )  # chi-squared with 8 degrees of freedom at 1e-4: 31.8/2
    truth = {name: getattr(make_plant(PRESET).parameters, name) for name in OWN[:2]} | NOISE
    for name, value in truth.items():
        assert abs(found.values[name] - value) < 3.9 * found.standard_errors[name], name
    for name in EFFECTS:
        test = found.null_tests[name]
        assert not found.determined[name] and test.is_zero and test.at == 0.0 and test.p > 1e-4, name
        assert test.log_likelihood <= found.log_likelihood + 1e-3
    said = " ".join(found.sentences())
    assert "The data are as likely without" in said and "lag_speed (p = " in said


def test_a_null_is_tested_as_the_normal_distribution_says():
    """Far from the end of a range the fall of log L is half the squared ratio of value and error."""
    found = identify(recorded(8, 300, offset=-0.03), pendulum, FREE, start={"offset": 0.0}, starts=1)
    test, ratio = found.null_tests["offset"], found.values["offset"] / found.standard_errors["offset"]
    assert test.is_zero and test.p == pytest.approx(math.erfc(abs(ratio) / math.sqrt(2)), rel=0.35)
    assert found.determined["offset"] == (abs(ratio) > 1.96)
    assert (
        found.null_tests["stiffness"].at == pytest.approx(FREE[0].default)
        and found.null_tests["stiffness"].p < 1e-6
    )
    assert not found.null_tests["stiffness"].is_zero and found.null_tests["stiffness"].said == "< 0.001"


@pytest.mark.slow
def test_the_probability_of_a_true_null_is_uniform():
    free = [one for one in FREE if one.name in ("damping", "offset")]
    found = []
    for k in range(60):
        one = identify(
            recorded(4, 80, first=50 * k, offset=0.0),
            lambda **values: pendulum(**{**TRUTH, **values}),
            free,
            start={"damping": TRUTH["damping"], "offset": 0.3},
            starts=1,
            simulation_first=False,
        )
        found.append(one.null_tests["offset"].p)
    ranks = np.sort(found)
    distance = np.abs(ranks - (np.arange(60) + 0.5) / 60).max()
    assert distance < 2.2 / math.sqrt(60)  # Kolmogorov and Smirnov at 1e-4


def test_a_better_place_that_a_test_finds_is_gone_to():
    """A start far from zero on a likelihood with two maxima ends in the better one, at zero."""
    data = recorded(4, 100, offset=0.0)

    def model(bend):
        return pendulum(**{**TRUTH, "offset": 0.0, "damping": 0.5 + 0.3 * math.sin(bend) ** 2 + 0.01 * abs(bend)})

    wide = (Parameter("bend", -4.0, 4.0, log=False, default=3.3),)
    lonely = identify(data, model, wide, starts=1, against=False, simulation_first=False)
    found = identify(data, model, wide, starts=1, simulation_first=False)
    assert found.log_likelihood >= lonely.log_likelihood - 1e-6


def test_a_value_whose_interval_holds_zero_is_not_determined():
    found = identify(recorded(8, 150, offset=0.0), pendulum, FREE, starts=1)
    inside = abs(found.values["offset"]) < 1.96 * found.standard_errors["offset"]
    assert inside and not found.determined["offset"]
    assert "The data do not distinguish offset from zero, which lies in a 95 % interval." in found.sentences()


@pytest.mark.parametrize("gate", [2.0, 2.5, 3.0, 4.0])
def test_a_gate_leaves_noise_and_constants_as_they_are(gate):
    found = identify(recorded(8, 400, first=40), pendulum, FREE, starts=1, gate=gate, against=False)
    for name, truth in TRUTH.items():
        assert abs(found.values[name] - truth) < 3.9 * found.standard_errors[name], name
    assert found.left_out > 5 or gate == 4.0
    assert found.values["r"] == pytest.approx(TRUTH["r"], rel=0.09)
    with pytest.raises(ValueError, match="gate must be at least 2 standard deviations, but got 1.5"):
        identify(recorded(2, 50), pendulum, FREE, gate=1.5)


def test_what_a_gate_leaves_of_a_normal_distribution():
    drawn = np.random.default_rng(0).normal(size=1_000_000)
    for gate in (1.0, 2.0, 3.0):
        kept = drawn[np.abs(drawn) <= gate] ** 2
        assert kept_variance(gate) == pytest.approx(kept.mean(), rel=5e-3)
        assert lost_information(gate) == pytest.approx(2 / kept.var(), rel=1e-2)
    assert kept_variance(math.inf) == lost_information(math.inf) == kept_variance(60.0) == 1.0


def test_a_probability_reads_as_a_table_has_it():
    assert NullTest(0.0, True, -1.0, 0.4321).said == "0.43" and NullTest(0.0, True, -1.0, 1e-9).said == "< 0.001"
