"""Every configuration: checked by both env checkers, and either refused with a rule or finite to its end."""

import gc
import math
import tracemalloc

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import thruster_env
from tests.thruster_env.thruster.test_sensors import EVERY_EFFECT as SENSORS
from thruster_env.core.compiled import interpreted
from thruster_env.thruster.effects import UNCERTAIN
from thruster_env.thruster.env import BowThrusterTrackingVectorEnv, BowThrusterVectorEnv
from thruster_env.thruster.parameters import PRESETS

IDS = ["BowThruster-v0", "BowThrusterTracking-v0", "BowThrusterReversal-v0", "BowThrusterLinear-v0"]
FLOW = [
    {"name": "sinusoid", "amplitude": 0.3},
    {"name": "gauss-markov", "std": 0.2},
    {"name": "gusts", "std": 0.5, "rate": 5.0, "duration": 0.1},
    {"name": "recorded", "values": [0.1, -0.3, 0.2]},
]
AMPLIFIER = [
    {"name": "dead-band", "width": 1.0},
    {"name": "slew-limit", "rate": 500.0},
    {"name": "saturation", "limit": 20.0},
    {"name": "sag", "fraction": 0.1},
]
REFERENCE = [
    {"name": "constant", "level": 0.2},
    {"name": "steps"},
    {"name": "ramps"},
    {"name": "prbs"},
    {"name": "multi-sine"},
    {"name": "band-limited-noise"},
    {"name": "recorded", "values": [1.0, 2.0]},
]
UNCERTAINTY = {
    "load_gain": {"name": "log-normal", "std": 0.1},
    "area": {"name": "uniform", "low": 0.9, "high": 1.1},
}


def configurations():
    """Every id with all disturbances that it takes, and each of them on one id, as all ids share a page."""
    for name in IDS:
        linear, follows = "Linear" in name, "Tracking" in name or "Reversal" in name
        channels = ["thrust", "speed", "speed-magnitude"] + ([] if linear else ["current"])
        one = [{"sensors": channels}, {"system": "open_bladed"} if linear else {"uncertainty": UNCERTAINTY}]
        if name == IDS[0]:
            one += [{"sensors": {"thrust": [effect]}} for effect in SENSORS]
            one += [{"flow": [signal]} for signal in FLOW] + [{"amplifier": [effect]} for effect in AMPLIFIER]
        one += [{"reference": [signal]} for signal in REFERENCE if name == IDS[1]]
        everything = {"sensors": dict.fromkeys(channels, SENSORS), "flow": FLOW, "amplifier": AMPLIFIER}
        everything |= {"reference": REFERENCE} if follows else {}
        everything |= {} if linear else {"uncertainty": UNCERTAINTY}
        for arguments in [*one, everything]:
            label = "everything" if arguments is everything else str(next(iter(arguments.values())))
            yield pytest.param(name, arguments, id=f"{name}-{label[:40]}")


# Their advice on bounds is not ours: volts are volts, and Gaussian noise has no bounds.
@pytest.mark.filterwarnings(r"ignore:.*(symmetric and normalized|probably too):UserWarning")
@pytest.mark.parametrize(("name", "arguments"), list(configurations()))
def test_both_checkers_pass(name, arguments):
    check_env(gym.make(name, **arguments).unwrapped, skip_render_check=True)
    stable_baselines = pytest.importorskip("stable_baselines3.common.env_checker")
    stable_baselines.check_env(gym.make(name, **arguments).unwrapped, warn=False, skip_render_check=True)


def some(rng, effects):
    """None, one or a few of some effects, in any order."""
    count = rng.choice([0, 1, 2, len(effects)])
    return [effects[i] for i in rng.choice(len(effects), count, replace=False)] or None


def random_covariance(rng, size):
    """A covariance that is zero, singular, tiny, large, full or, now and then, none at all."""
    factor = rng.normal(size=(size, int(rng.integers(1, size + 1)))) * 10.0 ** rng.uniform(-4, 2)
    choices = [np.zeros(size), np.abs(rng.normal(size=size)), factor @ factor.T, -np.ones(size), np.ones(size + 1)]
    cov = choices[rng.choice(5, p=[0.15, 0.3, 0.45, 0.05, 0.05])]
    return cov.tolist()


def random_arguments(rng):
    """An id and arguments, a few of them wrong."""
    name = str(rng.choice(IDS))
    linear, follows = "Linear" in name, "Tracking" in name or "Reversal" in name
    channels = rng.permutation(["thrust", "speed", "speed-magnitude", "current"][: 3 if linear else 4]).tolist()
    channels = channels[: rng.integers(1, len(channels) + 1)]
    arguments = {
        "dt": float(rng.choice([1e-4, 1e-3, 0.01, 0.02, 0.05, 0.1])),
        "max_voltage": float(rng.choice([6.0, 24.0])),
        "ambient_velocity": float(rng.choice([0.0, 0.0, 0.5, -1.5])),
        "process_noise_cov": random_covariance(rng, 2),
        "measurement_noise_cov": random_covariance(rng, len(channels)),
        "sensors": {channel: some(rng, SENSORS) for channel in channels},
        "flow": some(rng, FLOW),
        "amplifier": some(rng, AMPLIFIER),
    }
    if linear:
        arguments["system"] = str(rng.choice(["tunnel", "open_bladed"]))
    else:
        arguments["preset"] = str(rng.choice(list(PRESETS)))
        if rng.random() < 0.2:
            parameter = str(rng.choice([name for name in UNCERTAIN if name != "blade_angle"]))
            arguments["uncertainty"] = {parameter: UNCERTAINTY["area"]}
    if follows:
        arguments["reference"] = some(rng, REFERENCE)
    return name, arguments


def random_action(rng):
    """A voltage in or beyond the range, or something that must be refused."""
    kind = rng.random()
    if kind < 0.05:
        return [math.nan, [math.nan], [], [1.0, 2.0], np.zeros((2, 1)), "full", None][rng.integers(7)]
    if kind < 0.1:
        return [math.inf, [-math.inf], 1e300, np.float32(-1e30), np.array([[25.0]])][rng.integers(5)]
    return np.array([rng.uniform(-30, 30)], dtype=np.float32)


def is_refused(action):
    try:
        return not np.isfinite(action).all() if np.size(action) != 1 else bool(np.isnan(np.asarray(action, float)))
    except (TypeError, ValueError):
        return True


def is_finite(observation, info, reward=0.0):
    return all(np.isfinite(value).all() for value in (observation, reward, *info.values()))


def run_random_episode(env, rng, steps):
    """An episode whose results are finite until it is terminated; whether it was."""
    options = {}
    if rng.random() < 0.2:
        options["state"] = (rng.normal(size=2) * 10.0 ** rng.uniform(-3, 12)).tolist()
    observation, info = env.reset(seed=int(rng.integers(2**31)), options=options)
    assert is_finite(observation, info) and observation in env.observation_space
    for _ in range(steps):
        action = random_action(rng)
        if np.size(action) != 1 or is_refused(action):
            with pytest.raises(ValueError, match="an action must be one voltage"):
                env.step(action)
            continue
        observation, reward, terminated, truncated, info = env.step(action)
        assert type(reward) is float and type(terminated) is bool and type(truncated) is bool
        assert not np.isnan(observation).any()
        if terminated:
            return True
        assert is_finite(observation, info, reward) and observation in env.observation_space and reward <= 0
        assert abs(info["time"] / env.unwrapped.plant.dt - round(info["time"] / env.unwrapped.plant.dt)) < 1e-6
    return False


def run_random_episodes(seed, count, steps=20):
    """How many configurations were refused, and how many episodes were run and terminated."""
    rng, refused, done, terminated = np.random.default_rng(seed), 0, 0, 0
    while done < count:
        name, arguments = random_arguments(rng)
        try:
            env = gym.make(name, disable_env_checker=True, **arguments).unwrapped
        except ValueError as error:
            assert " must " in str(error) and "\n" not in str(error), arguments
            refused += 1
            continue
        for _ in range(8):
            try:
                terminated += run_random_episode(env, rng, steps)
            except AssertionError as error:
                raise AssertionError(f"{name}, {arguments}") from error
            done += 1
    return refused, done, terminated


@pytest.mark.slow
def test_random_configurations_are_refused_or_finite():
    refused, done, terminated = run_random_episodes(seed=1, count=300)
    assert refused > 3 and done >= 300 and terminated > 10


def test_python_and_machine_code_agree_with_everything_that_disturbs():
    channels = dict.fromkeys(["thrust", "speed", "speed-magnitude", "current"], SENSORS)
    arguments = {"sensors": channels, "flow": FLOW, "amplifier": AMPLIFIER, "reference": REFERENCE}

    def episodes():
        vector = BowThrusterTrackingVectorEnv(3, 30, "SameStep", uncertainty=UNCERTAINTY, **arguments)
        results = [vector.reset(seed=0)]
        results += [vector.step(np.random.default_rng(k).uniform(-24, 24, 3)) for k in range(40)]
        return [
            (*(result[:-1]), *(result[-1][key] for key in ("state", "measurement", "reference")))
            for result in results
        ]

    of_machine = episodes()
    with interpreted():
        of_python = episodes()
    for one, other in zip(of_machine, of_python, strict=True):
        for a, b in zip(one, other, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6 if a.dtype == np.float32 else 1e-11, atol=1e-11)


def test_copies_may_start_where_options_say():
    state, mask = [30.0, -0.5], np.array([False, True, True])
    vector, alone = BowThrusterVectorEnv(3, autoreset_mode="Disabled"), thruster_env.BowThrusterEnv()
    observation, info = vector.reset(seed=5, options={"state": state})
    np.testing.assert_array_equal(info["state"], [state] * 3)
    np.testing.assert_allclose(observation[1], alone.reset(seed=6, options={"state": state})[0], rtol=1e-6)
    moved, _ = vector.step(np.ones(3))[4]["state"], alone.step(1.0)
    info = vector.reset(options={"state": state, "reset_mask": mask})[1]
    np.testing.assert_array_equal(info["state"], [moved[0], state, state])
    alone.reset(options={"state": state})
    moved, expected = vector.step(np.ones(3))[4]["state"], alone.step(1.0)[4]["state"]
    np.testing.assert_allclose(moved[1], expected, rtol=1e-12, atol=1e-12)


def test_what_is_not_finite_is_observed_alike_by_both():
    envs = [make(initial_state=[1e50, 0.0]) for make in (BowThrusterVectorEnv, thruster_env.BowThrusterEnv)]
    vector, alone = (env.reset(seed=0)[0] for env in envs)
    np.testing.assert_array_equal(vector[0], alone)


@pytest.mark.parametrize("single", [True, False], ids=["single", "vector"])
def test_memory_does_not_grow(single, only_new_garbage):
    arguments = {"sensors": {"thrust": SENSORS}, "flow": FLOW, "reference": REFERENCE}
    if single:
        env = gym.make("BowThrusterTracking-v0", max_episode_steps=20, **arguments)
    else:
        env = BowThrusterTrackingVectorEnv(4, 20, **arguments)
    env.reset(seed=0)

    def used_after(steps):
        for _ in range(steps):
            if env.step(np.ones(1 if single else 4))[3] is True:
                env.reset()
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        before = used_after(200)
        assert used_after(800) - before < 4_000  # bytes
    finally:
        tracemalloc.stop()


def test_the_reward_stays_finite_when_the_state_does_not():
    noise = [[71.0, 120.0], [120.0, 716.0]]
    env = gym.make(
        "BowThruster-v0", preset="open_bladed_corrected", dt=0.02, max_voltage=6.0, process_noise_cov=noise
    )
    ends = []
    for seed in range(30):
        env.reset(seed=seed)
        for voltage in np.random.default_rng(seed).uniform(-6, 6, 200):
            _, reward, terminated, _, info = env.step([voltage])
            assert np.isfinite(reward)
            if terminated:
                ends.append(info["state"])
                break
    assert not np.isfinite(ends).all()  # the case is met
