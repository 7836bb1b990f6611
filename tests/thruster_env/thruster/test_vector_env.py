"""The native vector env: copy by copy the single env, and in its ways Gymnasium's own vector env."""

import copy
import json

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import thruster_env  # noqa: F401 - registers the envs
from thruster_env.thruster.env import BowThrusterVectorEnv

IDS = ["BowThruster-v0", "BowThrusterTracking-v0", "BowThrusterReversal-v0", "BowThrusterLinear-v0"]
NEXT_STEP, SAME_STEP, DISABLED = AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP, AutoresetMode.DISABLED
every_id = pytest.mark.parametrize("name", IDS)
every_mode = pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.value)
DISTURBED = {
    "sensors": {
        "thrust": [
            {"name": "student-t", "scale": 0.3},
            {"name": "outliers", "std": 5.0},
            {"name": "bias", "std": 0.1, "drift": 0.01},
            {"name": "saturation", "low": -500.0, "high": 500.0},
        ],
        "speed": [{"name": "quantisation", "step": 0.5}, {"name": "dropout", "probability": 0.3}],
        "speed-magnitude": [{"name": "dropout", "mean_length": 4.0}, {"name": "delay", "steps": 2}],
    },
    "flow": [
        {"name": "sinusoid", "amplitude": 0.2},
        {"name": "gauss-markov", "std": 0.1},
        {"name": "gusts", "std": 0.3, "rate": 5.0, "duration": 0.1},
        {"name": "recorded", "values": [0.0, 0.2, -0.1], "repeat": True},
    ],
    "amplifier": [
        {"name": "dead-band", "width": 1.0},
        {"name": "slew-limit", "rate": 2000.0},
        {"name": "saturation", "limit": 20.0},
        {"name": "sag", "fraction": 0.1},
    ],
}
SIGNALS = [
    {"name": "constant", "level": 0.1},
    {"name": "steps", "hold_time": 0.05},
    {"name": "ramps", "hold_time": 0.07},
    {"name": "prbs", "hold_time": 0.03},
    {"name": "multi-sine"},
    {"name": "band-limited-noise", "bandwidth": 5.0},
]


def wild(name):
    """Flows that often carry a state beyond its limits, in steps so short that it stays finite."""
    storm = {"name": "gauss-markov", "std": 3e7 if "Linear" in name else 3e3, "time_constant": 1e-4}
    return arguments(name, dt=1e-4, flow=[*DISTURBED["flow"], storm])


def arguments(name, **more):
    """All disturbances that an id takes."""
    own = {} if "Linear" in name else {"uncertainty": {"load_gain": {"name": "uniform", "low": 0.8, "high": 1.2}}}
    if "Tracking" in name or "Reversal" in name:
        own["reference"] = SIGNALS
    return DISTURBED | own | more


def make_vec(name, count, mode=NEXT_STEP, limit=500, **given):
    return gym.make_vec(name, count, autoreset_mode=mode.value, max_episode_steps=limit, **given)


class Single:
    """One env that begins anew as the autoreset mode says: what a copy has to report."""

    def __init__(self, name, mode, limit, seed, **given):
        self.env, self.mode, self.done = gym.make(name, max_episode_steps=limit, **given), mode, False
        self.start = self.env.reset(seed=seed)

    def step(self, action):
        """What a step returns, and the last observation and info of an episode that ends with it."""
        final = None
        if self.done and self.mode == NEXT_STEP:
            observation, info = self.env.reset()
            self.done = False
            return observation, 0.0, False, False, info, None
        observation, reward, terminated, truncated, info = self.env.step(np.atleast_1d(action))
        self.done = terminated or truncated
        if self.done and self.mode == SAME_STEP:
            final = observation, info
            observation, info = self.env.reset()
        return observation, reward, terminated, truncated, info, final

    def reset(self):
        self.done = False
        return self.env.reset()


def assert_info(found, i, expected):
    assert {key for key in found if not key.startswith(("_", "final"))} == set(expected)
    for key, value in expected.items():
        assert found[f"_{key}"][i]
        np.testing.assert_allclose(found[key][i], value, rtol=1e-12, atol=1e-12, err_msg=key)


def assert_copies_are_single_envs(
    name, count, mode, steps, limit, watched, exact=(), inputs=None, ulps=0, **given
):
    """Compare some copies, step by step; return how often one was terminated and truncated."""
    vector = make_vec(name, count, mode, limit, **given)
    singles = {i: Single(name, mode, limit, seed=7 + i, **given) for i in watched}
    observation, info = vector.reset(seed=7)
    for i, single in singles.items():
        np.testing.assert_allclose(observation[i], single.start[0], rtol=1e-6)
        assert_info(info, i, single.start[1])
    shape, ends = (steps, count) if inputs is None else (steps, count, inputs), np.zeros(2, dtype=int)
    for k, action in enumerate(np.random.default_rng(3).uniform(-30, 30, shape)):
        rows = inputs is None and k % 2  # one number per copy will do
        observation, reward, terminated, truncated, info = vector.step(action[:, None] if rows else action)
        assert observation.dtype == np.float32 and reward.dtype == np.float64
        assert terminated.dtype == truncated.dtype == bool
        for i, single in singles.items():
            expected = single.step(action[i])
            np.testing.assert_allclose(observation[i], expected[0], rtol=1e-6)
            assert reward[i] == pytest.approx(expected[1], rel=1e-11, abs=1e-12)
            assert (terminated[i], truncated[i]) == expected[2:4]
            assert_info(info, i, expected[4])
            for channel in exact:
                pair = info["measurement"][i, channel], expected[4]["measurement"][channel]
                np.testing.assert_array_max_ulp(*pair, ulps)
            ends += expected[2:4]
            if expected[5]:
                assert info["_final_obs"][i] and info["_final_info"][i]
                np.testing.assert_allclose(info["final_obs"][i], expected[5][0], rtol=1e-6)
                assert_info(info["final_info"], i, expected[5][1])
            elif "final_obs" in info:
                assert not info["_final_obs"][i] and info["final_obs"][i] is None
        done = terminated | truncated
        if mode == DISABLED and done.any():
            observation, info = vector.reset(options={"reset_mask": done})
            for i in set(np.flatnonzero(done)) & set(singles):
                expected = singles[i].reset()
                np.testing.assert_allclose(observation[i], expected[0], rtol=1e-6)
                assert_info(info, i, expected[1])
    return ends


@every_mode
@every_id
@pytest.mark.parametrize("count", [1, 130])
def test_a_copy_is_the_single_env_with_its_seed_over_many_episodes(name, mode, count):
    watched = sorted({0, 1, 2, 127, 128, 129} & set(range(count)))
    ends = assert_copies_are_single_envs(name, count, mode, 50, 12, watched, **wild(name))
    assert ends.sum() >= 4 * len(watched) and (ends.all() or count < 130)


# With all effects this is a kernel of fifteen seconds; the test above has them, in two blocks on one thread.
@every_mode
@pytest.mark.parametrize("given", [{}, pytest.param(wild(IDS[1]), marks=pytest.mark.slow)], ids=["plain", "wild"])
def test_copies_of_many_blocks_on_two_threads_are_single_envs(mode, given):
    name, watched = IDS[1] if given else IDS[0], [0, 127, 128, 600, 1023, 1024, 1099]
    ends = assert_copies_are_single_envs(name, 1100, mode, 25, 11, watched, **given)
    assert ends.all() if given else ends[1] > 0


@every_id
def test_copies_stay_single_envs_over_500_steps_and_quantisers_agree_to_the_bit(name):
    given = arguments(name, max_voltage=24.0)
    ends = assert_copies_are_single_envs(name, 5, NEXT_STEP, 501, 500, [0, 4], exact=[1], **given)
    np.testing.assert_array_equal(ends, [0, 2])


@every_mode
def test_a_plain_env_and_more_episodes_than_keys_are_drawn_ahead(mode):
    ends = assert_copies_are_single_envs(IDS[0], 3, mode, 90, 2, [0, 1, 2])
    assert ends[1] >= 3 * 30


def assert_same_info(found, expected):
    """Keys, types and masks are the same, and values where the mask is true."""
    assert set(found) == set(expected)
    for key in expected:
        if isinstance(expected[key], dict):
            assert_same_info(found[key], expected[key])
            continue
        assert (found[key].dtype, found[key].shape) == (expected[key].dtype, expected[key].shape), key
        there = expected[f"_{key}"] if not key.startswith("_") else slice(None)
        for one, other in zip(found[key][there], expected[key][there], strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-12, err_msg=key)


@every_mode
@every_id
def test_results_have_the_form_of_gymnasiums_own_vector_env(name, mode):
    given = wild(name)
    ours = make_vec(name, 3, mode, 9, **given)
    theirs = SyncVectorEnv([lambda: gym.make(name, max_episode_steps=9, **given)] * 3, autoreset_mode=mode)
    for space in ("action_space", "observation_space", "single_action_space", "single_observation_space"):
        assert getattr(ours, space) == getattr(theirs, space)
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"] == mode
    results = [env.reset(seed=[5, 9, 2]) for env in (ours, theirs)]
    for k in range(40):
        for found, expected in zip(results[0][:-1], results[1][:-1], strict=True):
            assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
            np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-12)
        assert_same_info(results[0][-1], results[1][-1])
        actions = np.random.default_rng(k).uniform(-24, 24, (3, 1)).astype(np.float32)
        done = np.logical_or(*results[0][2:4]) if len(results[0]) == 5 else np.zeros(3, dtype=bool)
        if mode == DISABLED and done.any():
            results = [env.reset(options={"reset_mask": done.copy()}) for env in (ours, theirs)]
        else:
            results = [env.step(actions) for env in (ours, theirs)]


def first_states(vector, **how):
    return [tuple(state) for state in vector.reset(**how)[1]["state"]]


def test_seeds_may_be_a_number_a_list_or_none():
    vector, alone = make_vec(IDS[0], 3), gym.make(IDS[0])
    of = {seed: tuple(alone.reset(seed=seed)[1]["state"]) for seed in (4, 5, 6, 90)}
    assert first_states(vector, seed=4) == [of[4], of[5], of[6]] == first_states(vector, seed=np.int64(4))
    assert first_states(vector, seed=[90, 4, 5]) == [of[90], of[4], of[5]]
    unseeded = first_states(vector)
    alone.reset(seed=4)
    assert unseeded[1] == tuple(alone.reset()[1]["state"])
    mixed = first_states(vector, seed=[6, None, 4])  # None: the next episode of that copy
    assert (mixed[0], mixed[2]) == (of[6], of[4]) and mixed[1] == tuple(alone.reset()[1]["state"])
    assert len({state for _ in range(2) for state in first_states(make_vec(IDS[0], 3))}) == 6
    with pytest.raises(ValueError, match="seed must be None, a number or 3 of these"):
        vector.reset(seed=[1, 2])


def test_a_masked_reset_leaves_the_other_copies_alone():
    vector, expected = make_vec(IDS[1], 3, DISABLED), make_vec(IDS[1], 3, DISABLED)
    mask = np.array([False, True, False])
    vector.reset(seed=1), expected.reset(seed=1)
    vector.step(np.ones(3)), expected.step(np.ones(3))
    observation, info = vector.reset(seed=[8, 9, 10], options={"reset_mask": mask})
    again, _ = gym.make(IDS[1]).reset(seed=9)
    np.testing.assert_array_equal(observation[1], again)
    np.testing.assert_array_equal(info["_state"], mask)
    assert not mask[0] and info["time"][1] == 0.0
    one, other = vector.step(np.ones(3)), expected.step(np.ones(3))
    np.testing.assert_array_equal(one[0][~mask], other[0][~mask])
    for wrong in ([True] * 2, np.zeros(3, dtype=bool), np.ones(3), "all"):
        with pytest.raises(ValueError, match="reset_mask must be 3 booleans, at least one of them true"):
            vector.reset(options={"reset_mask": wrong})


@pytest.mark.parametrize("count", [3, 130])
@every_mode
def test_what_a_call_returns_no_later_call_changes(mode, count):
    vector = make_vec(IDS[1], count, mode, 3, **arguments(IDS[1]))
    mask = {"reset_mask": np.arange(count) % 2 == 0}
    calls = [lambda: vector.reset(seed=0), *[lambda: vector.step(np.ones(count))] * 4]
    calls += [lambda: vector.reset(options=mask), *[lambda: vector.step(np.ones(count))] * 4]
    results = [(result, copy.deepcopy(result)) for result in (call() for call in calls)]
    for result, kept in results:
        for one, other in zip(result[:-1], kept[:-1], strict=True):
            np.testing.assert_array_equal(one, other)
        assert_same_info(result[-1], kept[-1])


@every_mode
def test_wrong_actions_are_refused_and_change_nothing(mode):
    vector, expected = (make_vec(IDS[0], 4, mode, 2) for _ in range(2))
    vector.reset(seed=0), expected.reset(seed=0)
    wrong = [np.zeros(3), np.zeros((2, 2)), np.zeros((1, 4)), np.zeros((4, 2)), 1.0, None, "full", [[1], [2, 3]]]
    for actions in [*wrong, np.array([0.0, np.nan, 0.0, np.inf])]:
        with pytest.raises(ValueError, match="actions must be"):
            vector.step(actions)
    actions = np.array([[np.inf], [-np.inf], [30.0], [0.0]])
    np.testing.assert_array_equal(vector.step(actions)[0], expected.step(np.clip(actions, -24, 24))[0])


def test_a_copy_about_to_begin_anew_ignores_even_nan():
    vector = make_vec(IDS[0], 2, NEXT_STEP, 1)
    vector.reset(seed=0), vector.step(np.zeros(2))
    observation, reward, _, _, info = vector.step(np.full(2, np.nan))
    assert np.isfinite(observation).all() and (reward == 0).all() and (info["time"] == 0).all()
    assert np.isfinite(vector.step(np.zeros(2))[1]).all()


@every_id
def test_make_vec_takes_json(name):
    given = json.loads(json.dumps(arguments(name)))
    vector = gym.make_vec(name, num_envs=2, autoreset_mode="SameStep", **given)
    assert isinstance(vector.unwrapped, BowThrusterVectorEnv) and vector.num_envs == 2
    assert vector.metadata["autoreset_mode"] == SAME_STEP
    observation, _ = vector.reset(seed=3)
    np.testing.assert_array_equal(observation[1], gym.make(name, **given).reset(seed=4)[0])
    ends = [vector.step(np.zeros(2))[3].all() for _ in range(500)]
    assert ends == [False] * 499 + [True]  # the id's own time limit


@pytest.mark.parametrize("given", [{"num_envs": 0}, {"autoreset_mode": "Never"}, {"max_episode_steps": 0}])
def test_wrong_arguments_of_the_vector_env_are_refused(given):
    with pytest.raises(ValueError, match=f"{next(iter(given))} must be"):
        BowThrusterVectorEnv(**given)
    with pytest.raises(ValueError, match="render_mode must be None in a vector env, but got 'rgb_array'"):
        BowThrusterVectorEnv(render_mode="rgb_array")
