"""Ambient flow: every signal against its definition, and that the flow which info tells is the one that acted."""

import math

import gymnasium as gym
import numpy as np
import pytest
from scipy import stats

import thruster_env  # noqa: F401 - registers the envs
from thruster_env.core.streams import episode_keys
from thruster_env.effects.effects import RecordedSeries
from thruster_env.thruster.analysis import run_substeps, state_range
from thruster_env.thruster.effects import FLOW_SIGNALS
from thruster_env.thruster.equations import copies_of
from thruster_env.thruster.parameters import PRESETS, TUNNEL
from thruster_env.thruster.plant import Task, make_plant

DT = 0.01
SURELY = 1e-4  # the probability with which a right program fails such a test, once for all seeds
SIGNALS = [
    {"name": "sinusoid", "amplitude": 0.5, "period": 0.7, "phase": 1.0},
    {"name": "gauss-markov", "std": 0.4, "time_constant": 0.3},
    {"name": "gusts", "std": 1.0, "rate": 3.0, "duration": 0.2},
    {"name": "recorded", "values": [0.1, -0.4, 0.9], "sample_time": 0.04},
]


def flows(signals, copies=3, steps=100, seed=0, **arguments):
    """U_0 of every step (copies, steps): column k - 1 acts from t_{k-1} to t_k."""
    plant = copies_of(make_plant(flow=signals, **arguments), Task(), copies)
    plant.begin(episode_keys(range(seed, seed + copies)))
    row = plant.report_rows["ambient_velocity"]
    return np.transpose([plant.step(np.zeros(copies))[row].copy() for _ in range(steps)])


def middles(steps=100, dt=DT):
    return (np.arange(steps) + 0.5) * dt


def test_without_signals_the_flow_is_constant():
    np.testing.assert_array_equal(flows(None, ambient_velocity=-0.3), np.full((3, 100), -0.3))


@pytest.mark.parametrize("dt", [0.01, 0.02])
def test_a_sinusoid_is_taken_in_the_middle_of_a_step(dt):
    expected = 0.5 * np.sin(2 * np.pi * middles(dt=dt) / 0.7 + 1.0)
    np.testing.assert_allclose(flows(SIGNALS[0], dt=dt), np.tile(expected, (3, 1)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("dt", [0.01, 0.03])
def test_a_gauss_markov_flow_is_stationary_normal_and_correlated_as_it_says(dt):
    std, decay = 0.4, math.exp(-dt / 0.3)
    x = flows(SIGNALS[1], copies=1500, dt=dt) / std
    innovations = (x[:, 1:] - decay * x[:, :-1]) / math.sqrt(1 - decay**2)
    for values in (x[:, 0], x[:, 50], x[:, -1], innovations):
        assert stats.kstest(values.ravel(), stats.norm.cdf).pvalue > SURELY
    assert abs((innovations * x[:, :-1]).mean()) < 4 / math.sqrt(innovations.size)
    assert abs((innovations[:, 1:] * innovations[:, :-1]).mean()) < 4 / math.sqrt(innovations.size)
    for lag in (1, 10, 40):
        correlation = (x[:, 0] * x[:, lag]).mean()
        assert abs(correlation - decay**lag) < 4 * math.sqrt((1 + decay ** (2 * lag)) / len(x))


def gust_shape(height, steps):
    """One-minus-cosine over its duration, in the middles of its steps."""
    return 0.5 * height * (1 - np.cos(2 * np.pi * (np.arange(steps) + 0.5) / steps))


def test_gusts_have_their_shape_heights_and_rate():
    steps, copies = 20, 300
    flow = flows(SIGNALS[2], copies=copies, steps=1000)
    heights, calm, begun = [], 0, 0
    for series in flow:
        k = 0
        if series[0]:  # it may have begun at the reset, half a step before the first middle
            k = int(np.argmax(series == 0))
        while k < len(series):
            calm += 1
            if series[k] == 0:
                k += 1
                continue
            begun += 1
            height = series[k] / gust_shape(1.0, steps)[0]
            shape = gust_shape(height, steps)[: len(series) - k]
            np.testing.assert_allclose(series[k : k + steps], shape, rtol=1e-9, atol=1e-12)
            heights.append(height)
            k += steps
    assert stats.kstest(heights, stats.norm.cdf).pvalue > SURELY
    assert stats.binomtest(begun, calm, 1 - math.exp(-3.0 * DT)).pvalue > SURELY


def test_without_a_rate_there_are_no_gusts():
    assert not flows({"name": "gusts", "std": 1.0, "rate": 0.0}, copies=50).any()


def test_random_flows_differ_between_copies_and_not_with_the_action():
    for signal in SIGNALS[1:3]:
        first, second, again = flows(signal, seed=0), flows(signal, seed=1), flows(signal, seed=0)
        np.testing.assert_array_equal(first, again)
        np.testing.assert_array_equal(first[1:], second[:-1])
        assert (first[0] != first[1]).any()


@pytest.mark.parametrize("sample_time", [0.04, 0.01, 0.003])
def test_a_recorded_flow_is_interpolated_and_its_last_value_stays(sample_time):
    values = [0.1, -0.4, 0.9, 0.0, 2.0]
    signal = {"name": "recorded", "values": values, "sample_time": sample_time}
    expected = np.interp(middles(), sample_time * np.arange(5), values)
    np.testing.assert_allclose(flows(signal), np.tile(expected, (3, 1)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("values", [[0.1, -0.4, 0.9], [0.7]])
def test_a_recorded_flow_may_begin_again(values):
    signal = {"name": "recorded", "values": values, "sample_time": 0.04, "repeat": True}
    expected = np.interp(middles(), 0.04 * np.arange(len(values)), values, period=0.04 * len(values))
    np.testing.assert_allclose(flows(signal)[0], expected, rtol=0, atol=1e-12)


def test_a_recorded_flow_may_come_from_a_file(tmp_path):
    path = tmp_path / "tide.csv"
    path.write_text("# time [s],tide U_0 [m/s],other\n0,0.5,9\n1,-0.5,9\n2,1.5,9\n")
    signal = {"name": "recorded", "file": str(path), "column": "tide U_0 [m/s]", "sample_time": 0.05}
    by_values = {"name": "recorded", "values": [0.5, -0.5, 1.5], "sample_time": 0.05}
    np.testing.assert_array_equal(flows(signal), flows(by_values))
    env = gym.make("BowThruster-v0", flow=[signal])
    assert env.spec.kwargs["flow"] == [signal]
    made = FLOW_SIGNALS.make(signal)[0]
    assert made.as_mapping() == signal | {"values": None, "repeat": False}
    assert FLOW_SIGNALS.make(made.as_mapping()) == (made,)


def test_signals_add_to_one_another_and_to_the_constant_flow():
    # A random signal keeps its place in the list, by which it draws.
    alone = [flows([{"name": "sinusoid", "amplitude": 0.0}] * i + [SIGNALS[i]]) for i in range(4)]
    np.testing.assert_allclose(flows(SIGNALS, ambient_velocity=0.3), 0.3 + sum(alone), rtol=0, atol=1e-12)


def test_equal_random_signals_in_one_list_are_independent():
    both = flows([SIGNALS[1]] * 2, copies=1000, steps=1)
    assert abs(both.var() / (2 * 0.4**2) - 1) < 4 * math.sqrt(2 / 1000)


@pytest.mark.parametrize("signal", [None, *SIGNALS], ids=lambda signal: signal["name"] if signal else "constant")
def test_the_flow_in_info_is_the_one_that_acted(signal):
    env = gym.make("BowThruster-v0", flow=signal, ambient_velocity=0.2, process_noise_cov=[0, 0])
    x = env.reset(seed=5)[1]["state"]
    for k, voltage in enumerate(np.random.default_rng(2).uniform(-24, 24, 60)):
        info = env.step([voltage])[4]
        if signal is None:
            assert info["ambient_velocity"] == 0.2
        inputs = (float(voltage), info["ambient_velocity"])
        moved = run_substeps(tuple(x), inputs, TUNNEL, DT, env.unwrapped.plant.substeps)
        np.testing.assert_allclose(info["state"], moved, rtol=1e-10, atol=1e-12, err_msg=str(k))
        x = info["state"]


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_flow_drags_the_water_and_turns_the_propeller_along(sign):
    signal = {"name": "recorded", "values": [sign * 2.0]}
    env = gym.make(
        "BowThruster-v0", preset="tunnel_physical", flow=signal, process_noise_cov=[0, 0], initial_state=[0, 0]
    )
    env.reset(seed=0)
    for _ in range(50):
        info = env.step([0.0])[4]
    assert sign * info["state"][1] > 0.2
    assert sign * info["thrust"] < 0  # the blades slow it down


@pytest.mark.parametrize("preset", ["open_bladed", "open_bladed_corrected"])
def test_a_flow_signal_is_followed_as_exactly_as_a_constant_flow(preset):
    plant = {"preset": preset, "process_noise_cov": [0, 0], "initial_state": [0, 0]}
    constant = gym.make("BowThruster-v0", ambient_velocity=3.0, **plant)
    recorded = gym.make("BowThruster-v0", flow=[{"name": "recorded", "values": [3.0]}], **plant)
    constant.reset(seed=0), recorded.reset(seed=0)
    limit = 1e-4 * state_range(PRESETS[preset], 24.0)
    for k in range(100):
        one, other = (env.step([24.0 if k % 20 < 10 else -24.0])[4]["state"] for env in (constant, recorded))
        assert (np.abs(one - other) <= limit).all()


def test_the_flow_of_an_episode_is_forgotten_at_the_next():
    env = gym.make("BowThruster-v0", flow=SIGNALS)

    def episode(seed):
        return [env.reset(seed=seed)[1]["ambient_velocity"]] + [
            env.step([0.0])[4]["ambient_velocity"] for _ in range(30)
        ]

    first, second = episode(4), episode(None)
    assert first[5:] != second[5:]
    assert episode(4) == first


WRONG = [
    (3.0, "flow must be a list of mappings with a name, but got 3.0"),
    ("gusts", "flow must be a list of mappings with a name, but got 'gusts'"),
    (
        [{"name": "tide"}],
        "each entry of flow must be a mapping whose name is one of sinusoid, gauss-markov, gusts",
    ),
    ([{"std": 1.0}], "each entry of flow must be a mapping whose name"),
    ([{"name": "sinusoid"}], "'sinusoid' must be given amplitude, period, phase"),
    ([{"name": "sinusoid", "amplitude": 1, "period": 0}], "period must be positive, but got 0"),
    ([{"name": "gauss-markov", "std": -1}], "std must be zero or positive, but got -1"),
    ([{"name": "gauss-markov", "std": 1, "time_constant": math.nan}], "time_constant must be a finite number"),
    ([{"name": "gusts", "std": 1, "rate": -2}], "rate must be zero or positive, but got -2"),
    ([{"name": "gusts", "std": 1, "duration": 0}], "duration must be positive, but got 0"),
    ([{"name": "gusts", "std": 1, "speed": 0}], "arguments of 'gusts' must be among std, rate, duration"),
    ([{"name": "recorded"}], "either values or file must be given, but got None and None"),
    ([{"name": "recorded", "values": [1], "file": "a.csv"}], "either values or file must be given"),
    ([{"name": "recorded", "values": []}], "values must be some finite numbers"),
    ([{"name": "recorded", "values": [1, math.nan]}], "values must be .*finite numbers"),
    ([{"name": "recorded", "values": [1], "sample_time": 0}], "sample_time must be positive, but got 0"),
    ([{"name": "recorded", "file": "nowhere.csv", "column": "u"}], "file must be a CSV file that exists"),
]


@pytest.mark.parametrize(("flow", "message"), WRONG)
def test_wrong_flows_are_refused_with_the_rule(flow, message):
    with pytest.raises(ValueError, match=message) as error:
        make_plant(flow=flow)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "file must be a CSV file"),
        ("u,v\n", "values must be some finite numbers"),
        ("u,v\n1,2,3\n", "file must be a CSV file with a header line"),
        ("u,v\n1,2\nx,3\n", "values must be .*finite numbers"),
        ("u,v\n,2\n1,3\n", "values must be .*finite numbers"),
        ("w\n1\n", "column must be one of w, but got 'u'"),
    ],
)
def test_a_file_that_holds_no_such_column_of_numbers_is_refused(tmp_path, text, message):
    path = tmp_path / "flow.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        RecordedSeries(file=str(path), column="u")
