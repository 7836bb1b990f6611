"""Reference signals against their definitions, when they are seen and used, and the reward that follows."""

import math
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import pytest
from scipy import signal, stats

import thruster_env  # noqa: F401 - registers the envs
from thruster_env.core.streams import episode_keys
from thruster_env.effects.effects import Effect
from thruster_env.thruster.analysis import steady_state
from thruster_env.thruster.effects import REFERENCE_SIGNALS
from thruster_env.thruster.env import BowThrusterReversalEnv, BowThrusterTrackingEnv
from thruster_env.thruster.equations import copies_of
from thruster_env.thruster.parameters import PRESETS, TUNNEL
from thruster_env.thruster.plant import Task, make_plant, make_task

T_MAX = steady_state(TUNNEL, 24.0).thrust
SURELY = 1e-4  # the probability with which a right program fails such a test, once for all seeds
LEVELS = {"low": -0.2, "high": 0.6, "hold_time": 0.1}
SIGNALS = [
    {"name": "constant", "level": 0.3},
    {"name": "steps", **LEVELS},
    {"name": "ramps", **LEVELS},
    {"name": "prbs", **LEVELS},
    {"name": "multi-sine", "amplitude": 0.1, "offset": 0.2, "periods": [1.0, 0.43]},
    {"name": "band-limited-noise", "std": 0.2, "offset": -0.1, "bandwidth": 4.0},
    {"name": "recorded", "values": [1.0, -3.0, 5.0], "sample_time": 0.05},
]
RANDOM = SIGNALS[1:6]


def references(signals, copies=3, steps=100, seed=0, sensors=None, **arguments):
    """r_0 ... r_steps of some copies, in T_max: (copies, steps + 1)."""
    plant = make_plant(sensors=sensors, **arguments)
    task = Task(REFERENCE_SIGNALS.make(signals))
    thrusters = copies_of(plant, task, copies)
    reports = [thrusters.begin(episode_keys(range(seed, seed + copies))).copy()]
    reports += [thrusters.step(np.zeros(copies)).copy() for _ in range(steps)]
    seen, ahead = (
        np.transpose([report[thrusters.report_rows[name]] for report in reports])
        for name in ("reference", "next_reference")
    )
    np.testing.assert_array_equal(ahead[:, :-1], seen[:, 1:])
    return seen / T_MAX


def times(steps=100, dt=0.01):
    return np.arange(steps + 1) * dt


def assert_uniform(values, low=-0.2, high=0.6):
    assert stats.kstest(np.ravel(values), stats.uniform(low, high - low).cdf).pvalue > SURELY


def assert_uncorrelated(one, other):
    assert abs(np.corrcoef(np.ravel(one), np.ravel(other))[0, 1]) < 4 / math.sqrt(np.size(one))


def test_a_constant_is_a_level_or_a_thrust():
    np.testing.assert_allclose(references({"name": "constant", "level": -0.4}), -0.4, rtol=1e-12)
    np.testing.assert_allclose(references({"name": "constant", "thrust": 7.0}), 7.0 / T_MAX, rtol=1e-12)


@pytest.mark.parametrize("dt", [0.01, 0.02])
def test_steps_hold_uniform_levels(dt):
    r, hold = references(SIGNALS[1], copies=500, dt=dt), round(0.1 / dt)
    levels = r[:, ::hold]
    # An episode's start and its steps are two programs, whose last digits may differ.
    np.testing.assert_allclose(r, np.repeat(levels, hold, axis=1)[:, :101], rtol=0.0, atol=1e-15)
    assert_uniform(levels)
    assert_uncorrelated(levels[:, 1:], levels[:, :-1])
    assert_uncorrelated(levels[1:], levels[:-1])


def test_ramps_are_straight_between_uniform_levels():
    r = references(SIGNALS[2], copies=500)
    levels = r[:, ::10]
    straight = [np.interp(np.arange(101), np.arange(0, 101, 10), own) for own in levels]
    np.testing.assert_allclose(r, straight, rtol=0, atol=1e-12)
    assert_uniform(levels)
    assert_uncorrelated(levels[:, 1:], levels[:, :-1])


def test_a_binary_sequence_has_two_levels_with_equal_chance():
    r = references(SIGNALS[3], copies=500)
    levels = r[:, ::10]
    np.testing.assert_array_equal(r, np.repeat(levels, 10, axis=1)[:, :101])
    np.testing.assert_allclose(np.unique(levels), [-0.2, 0.6], rtol=1e-12)
    high = levels > 0
    assert stats.binomtest(int(high.sum()), high.size, 0.5).pvalue > SURELY
    assert_uncorrelated(high[:, 1:], high[:, :-1])


def test_a_multi_sine_has_its_periods_amplitudes_and_uniform_phases():
    r = references(SIGNALS[4], copies=400)
    angles = 2 * np.pi * times()[:, None] / [1.0, 0.43]
    basis = np.column_stack([np.ones(101), np.sin(angles), np.cos(angles)])
    found, residual = np.linalg.lstsq(basis, r.T, rcond=None)[:2]
    np.testing.assert_allclose(residual, 0, atol=1e-20)
    np.testing.assert_allclose(found[0], 0.2, rtol=1e-9)
    sines, cosines = found[1:3], found[3:5]
    np.testing.assert_allclose(np.hypot(sines, cosines), 0.1, rtol=1e-9)
    phases = np.arctan2(cosines, sines) % (2 * np.pi)
    assert_uniform(phases, 0.0, 2 * np.pi)
    assert_uncorrelated(phases[0], phases[1])


@pytest.mark.parametrize(("bandwidth", "dt"), [(4.0, 0.01), (0.5, 0.01), (0.5, 0.001)])
def test_band_limited_noise_is_butterworth_noise_from_the_start(bandwidth, dt):
    copies = 1500
    r = references(SIGNALS[5] | {"bandwidth": bandwidth}, copies=copies, dt=dt)
    x = (r + 0.1) / 0.2
    for k in (0, 1, 50, 100):
        assert stats.kstest(x[:, k], stats.norm.cdf).pvalue > SURELY
    # White noise through the filter has the covariance of its impulse response with itself.
    impulse = np.zeros(round(20 / bandwidth / dt))
    impulse[0] = 1.0
    response = signal.lfilter(*signal.butter(2, bandwidth, fs=1 / dt), impulse)
    for lag in (1, 5, 20, 100):
        expected = response[lag:] @ response[: len(response) - lag] / (response @ response)
        for k in (0, 50):
            if k + lag <= 100:
                found = (x[:, k] * x[:, k + lag]).mean()
                assert abs(found - expected) < 4 * math.sqrt((1 + expected**2) / copies)


@dataclass(frozen=True)
class StepNumber(Effect):
    """A reference [N] that is the number of its step, beside one that draws."""

    name = "step-number"

    @staticmethod
    def act(e, value, memory, t):
        """Add the number of the step."""
        return value + t.step + 0.1 * t.normals()[0], memory


def test_a_reference_signal_of_a_user_begins_with_step_0():
    thrusters = copies_of(make_plant(), Task((StepNumber(),)), 1)
    reports = [thrusters.begin(episode_keys([3])).copy()]
    reports += [thrusters.step(np.zeros(1)).copy() for _ in range(3)]
    rows = (thrusters.report_rows[name] for name in ("reference", "next_reference"))
    now, following = ([float(report[row, 0]) for report in reports] for row in rows)
    assert now[1:] == following[:-1] and [round(value) for value in (*now, following[-1])] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("repeat", [False, True])
def test_a_recorded_reference_is_interpolated_at_the_sample_times(tmp_path, repeat):
    path = tmp_path / "thrust.csv"
    path.write_text("wanted\n1\n-3\n5\n")
    of_file = {"name": "recorded", "file": str(path), "column": "wanted", "sample_time": 0.05, "repeat": repeat}
    period = {"period": 0.15} if repeat else {}
    expected = np.interp(times(), [0.0, 0.05, 0.1], [1.0, -3.0, 5.0], **period) / T_MAX
    for given in (SIGNALS[6] | {"repeat": repeat}, of_file):
        np.testing.assert_allclose(references(given), np.tile(expected, (3, 1)), rtol=0, atol=1e-12)


def test_signals_are_added():
    zero = {"name": "constant", "level": 0.0}  # keeps the others in their places, by which they draw
    alone = [references([zero] * i + [SIGNALS[i]]) for i in range(7)]
    np.testing.assert_allclose(references(SIGNALS), sum(alone), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(references([]), np.zeros((3, 101)))


@pytest.mark.parametrize("given", RANDOM, ids=lambda given: given["name"])
def test_what_is_random_follows_from_the_seed_alone(given):
    first, shifted = references(given, seed=0), references(given, seed=1)
    np.testing.assert_allclose(first[1:], shifted[:-1], rtol=1e-12)
    assert (first[0] != first[1]).any()
    sensors = {"thrust": [{"name": "student-t", "scale": 1.0}], "speed": [{"name": "dropout"}]}
    flow, amplifier = [{"name": "gauss-markov", "std": 1.0}], [{"name": "slew-limit", "rate": 1.0}]
    disturbed = references(given, sensors=sensors, flow=flow, amplifier=amplifier)
    np.testing.assert_array_equal(disturbed, first)
    twice = references([given, given], copies=200) - references(given, copies=200)
    assert abs(np.corrcoef(twice[:, 7], references(given, copies=200)[:, 7])[0, 1]) < 4 / math.sqrt(200)


@pytest.mark.parametrize("given", RANDOM, ids=lambda given: given["name"])
def test_every_episode_draws_anew(given):
    env = gym.make("BowThrusterTracking-v0", reference=[given])

    def episode(seed):
        env.reset(seed=seed)
        return [env.step([0.0])[4]["reference"] for _ in range(60)]

    first, second = episode(4), episode(None)
    assert len(set(first)) > 1 and first != second
    assert (episode(4), episode(None)) == (first, second)


@pytest.mark.parametrize("task", ["Tracking", "Reversal"])
@pytest.mark.parametrize("weights", [(1.0, 0.0, 0.01), (0.5, 0.2, 0.3)])
def test_observation_k_holds_the_reference_that_the_next_reward_uses(task, weights):
    names = ("tracking_weight", "energy_weight", "voltage_rate_weight")
    arguments = dict(zip(names, weights, strict=True)) | {"sensors": ["speed", "thrust"]}
    env = gym.make(f"BowThruster{task}-v0", reference=SIGNALS, **arguments)
    expected = references(SIGNALS, copies=1, seed=6)[0] * T_MAX
    observation, info = env.reset(seed=6)
    before = 0.0
    for k, voltage in enumerate(np.random.default_rng(0).uniform(-30, 30, 100)):
        assert info["reference"] == pytest.approx(expected[k], rel=1e-12)
        assert observation.shape == (3,) and observation[-1] == np.float32(expected[k + 1])
        observation, reward, _, _, info = env.step([voltage])
        voltage = np.clip(voltage, -24, 24) / 24
        error = (info["thrust"] - expected[k + 1]) / T_MAX
        costs = np.array([error**2, voltage**2, (voltage - before) ** 2])
        assert reward == pytest.approx(-np.dot(weights, costs), rel=1e-9)
        before = voltage


def test_tracking_follows_steps_ahead_by_default():
    env = BowThrusterTrackingEnv()
    default = references({"name": "steps", "low": 0.1, "high": 0.8, "hold_time": 1.0}, copies=1, steps=450, seed=2)
    env.reset(seed=2)
    found = np.array([env.step([0.0])[4]["reference"] for _ in range(450)]) / T_MAX
    np.testing.assert_allclose(found, default[0, 1:], rtol=1e-12)
    assert found.min() >= 0.1 and found.max() <= 0.8 and len(np.unique(found)) == 5


def test_reversal_crosses_zero_in_ramps_by_default():
    env = BowThrusterReversalEnv()
    default = references(
        {"name": "ramps", "low": -0.6, "high": 0.6, "hold_time": 1.0}, copies=1, steps=499, seed=2
    )
    crossings = []
    for seed in range(2, 22):
        env.reset(seed=seed)
        found = np.array([env.step([0.0])[4]["reference"] for _ in range(499)]) / T_MAX
        crossings.append((np.diff(np.sign(found)) != 0).sum())
        if seed == 2:
            np.testing.assert_allclose(found, default[0, 1:], rtol=1e-12)
        assert np.abs(found).max() <= 0.6
    assert np.mean(crossings) > 1.5  # 5 pairs of levels, each of opposite signs with probability 1/2


@pytest.mark.parametrize("preset", PRESETS)
def test_levels_are_fractions_of_the_steady_thrust_at_max_voltage(preset):
    env = BowThrusterTrackingEnv(preset, max_voltage=12.0, reference={"name": "constant", "level": 0.5})
    info = env.reset(seed=0)[1]
    assert info["reference"] == pytest.approx(steady_state(PRESETS[preset], 12.0).thrust / 2, rel=1e-12)
    assert env.thrust_scale == pytest.approx(2 * info["reference"])


WRONG = [
    (3.0, "reference must be a list of mappings with a name, but got 3.0"),
    ("steps", "reference must be a list of mappings with a name, but got 'steps'"),
    (
        [{"name": "spiral"}],
        "each entry of reference must be a mapping whose name is one of constant, steps, ramps",
    ),
    ([{"name": "constant"}], "either level or thrust of a constant must be given, but got None and None"),
    ([{"name": "constant", "level": 1, "thrust": 1}], "either level or thrust of a constant must be given"),
    ([{"name": "constant", "thrust": math.nan}], "thrust must be a finite number, but got nan"),
    ([{"name": "steps", "low": 0.5, "high": 0.4}], "low must be at most high, but got 0.5 and 0.4"),
    ([{"name": "ramps", "hold_time": 0}], "hold_time must be positive, but got 0"),
    ([{"name": "prbs", "levels": 3}], "arguments of 'prbs' must be among low, high, hold_time, but got"),
    ([{"name": "multi-sine", "periods": []}], "periods must be some finite numbers"),
    ([{"name": "multi-sine", "periods": [1, 0]}], "periods must be positive, but got"),
    ([{"name": "band-limited-noise", "std": -1}], "std must be zero or positive, but got -1"),
    ([{"name": "band-limited-noise", "bandwidth": 50.0}], "below 50 Hz at this dt, but got 50"),
    ([{"name": "band-limited-noise", "bandwidth": 1e-5}], "bandwidth must be at least 0.001 Hz and below 50 Hz"),
    ([{"name": "recorded"}], "either values or file must be given"),
]


@pytest.mark.parametrize(("reference", "message"), WRONG)
def test_wrong_references_are_refused_with_the_rule(reference, message):
    with pytest.raises(ValueError, match=message) as error:
        BowThrusterTrackingEnv(reference=reference)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["tracking", "energy", "voltage_rate"])
def test_wrong_weights_are_refused(name):
    weights = {"tracking_weight": 1.0, "energy_weight": 0.0, "voltage_rate_weight": 0.0}
    with pytest.raises(ValueError, match=f"{name}_weight must be zero or positive, but got -1.0"):
        make_task(None, **weights | {f"{name}_weight": -1.0})
