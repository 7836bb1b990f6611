"""Runs that begin elsewhere than the prior says, effects that are not there, gates: values stay the truth's."""

import math

import numpy as np
import pytest

from filters.sensitivity import ModelSlopes, sensitivity
from filters.starts import Starts
from tests.filters.test_sensitivity import pendulum
from tests.models import random_affine
from tests.tuning.test_identify import FREE, TRUTH, recorded
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.logs.log import Log
from thruster_env.model.simulate import simulate
from thruster_env.thruster.model import Recorder, logged_model
from thruster_env.thruster.plant import make_plant
from tuning.likelihood.identify import identify, validate
from tuning.likelihood.objective import kept_variance, lost_information
from tuning.likelihood.recorded import starts_of
from tuning.likelihood.result import NullTest
from tuning.plants.thruster_logs import ThrusterFamily
from tuning.problems.data import Data
from tuning.problems.excitation import held_levels
from tuning.problems.problem import Parameter

OWN = ("motor_damping", "voltage_gain", "lift_coefficient")
NOISE = {"Q11": 1.0, "Q22": 4e-4, "R11": 0.25, "R22": 4.0}
PRESET = "tunnel_physical"


def thruster_logs(sensors=("thrust", "speed"), first=0, speeds=((120.0, 160.0),) * 4, steps=400, gap=None):
    """Runs of a thruster that begin at speeds within pairs of ends [rad/s], or at rest for None."""
    noise = [NOISE["R11"] if sensor == "thrust" else NOISE["R22"] for sensor in sensors]
    noise = {"process_noise_cov": [1.0, 4e-4], "measurement_noise_cov": noise}
    model = logged_model(preset=PRESET, sensors=sensors, **noise)
    rng, keys = np.random.default_rng(first), episode_keys(range(first, first + len(speeds)))
    inputs = held_levels(keys, 12.0, 25, steps)[..., None]
    made = []
    for k, ends in enumerate(speeds):
        speed = 0.0 if ends is None else rng.uniform(*ends)
        moving = {"prior_mean": [speed, 0.02 * speed], "prior_cov": np.zeros((2, 2))}
        drawn = simulate(model if ends is None else model.replace(**moving), keys[k : k + 1], inputs[k : k + 1])
        rows = drawn.measurements[0].copy()
        if gap is not None:
            rows[gap] = np.nan
        made.append(Log(f"run {k}", 0.01, inputs[k], rows, model.input_quantities, model.measurements))
    return made


def identified(logs, sensors=("thrust", "speed"), free=OWN, **options):
    family = ThrusterFamily(logs, make_plant(PRESET, sensors=sensors, max_voltage=12.0), Recorder(), free)
    return identify(family.data, family.model, family.free, starts=1, against=False, **options)


def check(found, noise):
    truth = {name: getattr(make_plant(PRESET).parameters, name) for name in OWN} | noise
    for name in found.names:
        assert abs(found.values[name] - truth[name]) < 3.9 * found.standard_errors[name], name
    determined = [name for name, known in found.determined.items() if known]
    assert set(determined) >= {"motor_damping", "voltage_gain"}


def test_logs_that_begin_at_speed_give_the_noise_and_constants_of_the_truth():
    found = identified(thruster_logs())
    assert found.begun_elsewhere == (0, 1, 2, 3)
    check(found, NOISE)
    assert found.standard_errors["R22"] < 0.4 and found.standard_errors["Q11"] < 0.5
    (said,) = [one for one in found.sentences() if "begin" in one]
    begins = "4 of 4 runs (1, 2, 3, 4) do not begin as the model's prior says: "
    assert said == f"{begins}the first 50 rows only determine the initial state and are not scored."
    checked = validate(found, thruster_logs(first=50, speeds=((150.0, 150.0), None, (-140.0, -120.0))))
    assert checked["identified"].nis == pytest.approx(1.0, abs=0.1)
    assert checked["identified"].fit["speed"] > 95


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensors", "noise"),
    [(("speed",), {"Q11": 1.0, "Q22": 4e-4, "R": 4.0}), (("thrust",), {"Q11": 1.0, "Q22": 4e-4, "R": 0.25})],
)
def test_one_sensor_tells_where_runs_begin_too(sensors, noise):
    logs = thruster_logs(sensors, speeds=((120.0, 160.0), (-160.0, -120.0), (120.0, 160.0), (60.0, 90.0)))
    found = identified(logs, sensors, OWN if sensors == ("thrust",) else OWN[:2])
    assert found.begun_elsewhere == (0, 1, 2, 3)
    check(found, noise)


def test_runs_from_rest_and_others_are_told_apart_and_gaps_are_no_trouble():
    starts = (None, (120.0, 160.0), None, (-150.0, -130.0), None)
    found = identified(thruster_logs(speeds=starts, gap=slice(5, 25)))
    assert found.begun_elsewhere == (1, 3)
    assert "2 of 5 runs (2, 4) do not begin" in " ".join(found.sentences())
    check(found, NOISE)
    silent = identified(thruster_logs(gap=slice(0, 150)))  # by then nothing is left of the start
    check(silent, NOISE)


def test_from_rest_nothing_changes_by_the_free_starts():
    logs = thruster_logs(speeds=(None,) * 3, steps=200)
    found = identified(logs)
    assert found.begun_elsewhere == () and found.objective.starts is None
    assert not any("begin" in one for one in found.sentences())


def displaced(by, count=6, steps=150):
    """Runs of the pendulum whose prior means are displaced."""
    model = pendulum(**TRUTH)
    made = recorded(count, steps)
    moved = model.replace(prior_mean=model.prior_mean + by)
    drawn = simulate(moved, episode_keys(range(count)), made.inputs).measurements
    return Data(made.seeds, made.inputs, drawn, filter_keys(made.seeds), 0)


def test_a_model_of_a_user_whose_runs_begin_elsewhere():
    found = identify(displaced(np.array([2.0, -5.0])), pendulum, FREE, starts=1, against=False)
    assert found.begun_elsewhere == tuple(range(6))
    for name, truth in TRUTH.items():
        assert abs(found.values[name] - truth) < 3.9 * found.standard_errors[name], name


def test_a_first_state_is_that_of_the_normal_equations():
    """For a linear model and a wide prior it is the least-squares estimate from the first rows."""
    model = random_affine()
    noise = {"process_noise_cov": 1e-12 * np.eye(3), "measurement_noise_cov": [0.5, 2.0]}
    model = model.replace(**noise, prior_cov=1e-6 * np.eye(3))
    rng = np.random.default_rng(3)
    truth, steps = 30.0 * rng.normal(size=model.n), 80
    inputs = rng.normal(size=(1, steps, model.inputs))
    quiet = model.replace(prior_mean=truth, prior_cov=np.zeros((model.n, model.n)))
    drawn = simulate(quiet, episode_keys([0]), inputs).measurements
    found = starts_of(model, Data((0,), inputs, drawn, filter_keys((0,)), 0))
    assert found.free.tolist() == [True] and found.leads.tolist() == [20]
    columns = []
    for state in (np.zeros(model.n), *np.eye(model.n)):
        x, shown = tuple(state), [model.observe(tuple(state), model.given_constants)]
        for k in range(19):
            x = model.transition(x, tuple(inputs[0, k]), model.given_constants)
            shown.append(model.observe(x, model.given_constants))
        columns.append(np.ravel(shown))
    rest = drawn[0, :20].ravel() - columns[0]
    matrix = np.column_stack([one - columns[0] for one in columns[1:]])
    weights = np.tile(1 / np.sqrt(np.diag(model.measurement_noise_cov)), 20)
    expected = np.linalg.lstsq(matrix * weights[:, None], rest * weights, rcond=None)[0]
    spread = np.sqrt(np.diag(np.linalg.inv((matrix * weights[:, None]).T @ (matrix * weights[:, None]))))
    assert (np.abs(found.means[0] - expected) < 0.3 * spread).all()


def test_a_lead_in_is_left_out_of_the_likelihood_and_its_slopes():
    """log p(later rows | first rows) is log p(all) - log p(first ones)."""
    model, data = pendulum(**TRUTH), recorded(2, 60)
    none = ModelSlopes(*(np.zeros((1, *np.shape(getattr(model, name)))) for name in ModelSlopes._fields))
    slopes = none._replace(measurement_noise_cov=model.measurement_noise_cov[None])
    means = np.array([[1.0, 0.5], [0.0, 0.0]])
    begun = Starts(np.array([True, False]), means, np.tile(np.eye(2), (2, 1, 1)), np.array([20, 0]))
    found = sensitivity(model, data.inputs, data.measurements, slopes, starts=begun)
    own = model.replace(prior_mean=means[0], prior_cov=np.eye(2))
    parts = ((data.inputs[:1, : end - 1], data.measurements[:1, :end]) for end in (20, 61))
    first, all_rows = (sensitivity(own, *part, slopes) for part in parts)
    for name in ("values", "gradients", "information"):
        expected = getattr(all_rows, name)[0] - getattr(first, name)[0]
        np.testing.assert_allclose(getattr(found, name)[0], expected, rtol=1e-9)
    plain = sensitivity(model, data.inputs[1:], data.measurements[1:], slopes)
    np.testing.assert_allclose(found.values[1], plain.values[0], rtol=1e-12)


def test_a_prior_that_is_free_stays_what_the_model_says():
    def model(spread, **values):
        return pendulum(**values).replace(prior_cov=spread * np.eye(2))

    free = (*FREE, Parameter("spread", 1e-3, 100.0, default=0.1))
    found = identify(displaced(np.array([2.0, -5.0])), model, free, starts=1, against=False)
    assert found.begun_elsewhere == () and found.values["spread"] > 5.0


EFFECTS = "lag_speed", "lag_thrust", "dead_band_low", "dead_band_high", "bias_thrust", "bias_speed"
EFFECTS += "thrust_asymmetry", "ambient_velocity"


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
    assert found.log_likelihood < plain.log_likelihood + 15.0  # chi-squared, 8 degrees of freedom, 1e-4: 31.8/2
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
    assert found.null_tests["stiffness"].at == pytest.approx(FREE[0].default)
    assert found.null_tests["stiffness"].p < 1e-6
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


def test_what_a_gate_leaves_of_a_normal_distribution_and_how_a_probability_reads():
    drawn = np.random.default_rng(0).normal(size=1_000_000)
    for gate in (1.0, 2.0, 3.0):
        kept = drawn[np.abs(drawn) <= gate] ** 2
        assert kept_variance(gate) == pytest.approx(kept.mean(), rel=5e-3)
        assert lost_information(gate) == pytest.approx(2 / kept.var(), rel=1e-2)
    assert kept_variance(math.inf) == lost_information(math.inf) == kept_variance(60.0) == 1.0
    assert NullTest(0.0, True, -1.0, 0.4321).said == "0.43" and NullTest(0.0, True, -1.0, 1e-9).said == "< 0.001"
