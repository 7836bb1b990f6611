"""Logs as envs: any wrapper runs on them, with the log's inputs."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import filters  # noqa: F401 - its wrappers
from filters import EstimateStates
from filters.logs.estimate import estimate
from tests.thruster_env.logs.test_logs import MODEL
from thruster_env.env.model_env import ReplayEnv
from thruster_env.logs.log import Log
from thruster_env.logs.write import write_log


@pytest.fixture
def log():
    draws = np.random.default_rng(4).normal(size=(31, 2))
    measured = np.cumsum(draws[:, :1], axis=0)
    measured[[0, 7]] = np.nan
    references = {"state:n": np.where(np.arange(31) % 3, np.nan, measured[:, 0])}
    quantities = MODEL.input_quantities, MODEL.measurements
    return Log("run", 0.1, draws[:30, 1:], measured, *quantities, references, {"state:n": MODEL.states[0]})


def ridden(env, seed=None):
    observation, info = env.reset(seed=seed)
    rows = [(observation, info)]
    while not rows[-1][1].get("over"):
        observation, _, terminated, truncated, info = env.step(np.full(1, 99.0))
        rows.append((observation, info | {"over": truncated}))
        assert not terminated
    return rows


def test_an_episode_is_the_log(log):
    rows = ridden(ReplayEnv(log, MODEL))
    assert len(rows) == 31
    assert rows[0][0] == 0.0 and not rows[0][1]["measurement_valid"]  # nothing was measured yet
    for k in range(1, 31):
        if k != 7:
            assert rows[k][0] == log.measurements[k] and rows[k][1]["measurement_valid"]
        np.testing.assert_array_equal(rows[k][1]["recorded_input"], log.inputs[k - 1])
    assert rows[7][0] == log.measurements[6]
    assert rows[3][1]["references"] == {"state:n": log.references["state:n"][3]} and not rows[4][1]["references"]
    env = ReplayEnv(log, MODEL)
    with pytest.raises(ValueError, match="a log must be reset after its last row"):
        for _ in range(40):
            env.step([0.0])


def test_vector_wrappers_use_the_recorded_inputs_too(log):
    found = estimate(log, "kf", MODEL)
    envs = EstimateStates(gym.vector.SyncVectorEnv([lambda: ReplayEnv(log, MODEL)] * 2), "kf", model=MODEL)
    envs.reset(seed=0)
    for _ in range(30):
        info = envs.step(np.full((2, 1), -5.0))[4]
    np.testing.assert_allclose(info["estimate"], np.tile(found.means[30], (2, 1)), rtol=1e-12)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_checkers_of_gymnasium_pass_on_a_file(log, tmp_path):
    write_log(tmp_path / "run.csv", log)
    made = gym.make("Replay-v0", log=str(tmp_path / "run.csv"), model="tests.thruster_env.logs.test_logs:MODEL")
    check_env(made.unwrapped, skip_render_check=True)
    assert made.unwrapped.state_space_model(process_noise_cov=[7.0]).process_noise_cov[0, 0] == 7.0
    again = gym.make(gym.envs.registration.EnvSpec.from_json(made.spec.to_json()))
    np.testing.assert_array_equal(again.unwrapped.log.measurements, log.measurements)


def test_what_is_no_model_of_the_log_is_refused(log):
    with pytest.raises(ValueError, match=r"inputs of log run must be the model's, none, but it has V_s \[V\]"):
        ReplayEnv(log, lambda dt: MODEL.replace(inputs=0, input_quantities=None, transition=lambda x, u, c: x))
    with pytest.raises(ValueError, match="the model of a log must be a StateSpaceModel, a function .* but got 3"):
        ReplayEnv(log, 3)
    with pytest.raises(ValueError, match="the model of a log must be made without arguments, but .* raised TypeE"):
        ReplayEnv(log, lambda speed: MODEL)
    with pytest.raises(ValueError, match="the model of a log must be a StateSpaceModel, but .* makes 4"):
        ReplayEnv(log, lambda: 4)


def test_arguments_of_another_kind_are_one_line(tmp_path):
    (tmp_path / "run.csv").write_text("t,V_s,tach\n0,1,2\n1,2,3\n2,3,4\n")
    path = tmp_path / "run.csv"
    for log, options, said in (
        (5, {}, "a log must be the path of a file, a pandas.DataFrame, .* or a Log, but got 5"),
        (path, {"columns": ["tach"]}, "columns must be a mapping from quantities, but got"),
        (path, {"columns": {"tach": 5}}, "the column for tach must be a header, but got 5"),
        (path, {"clock_offset": 0.1}, "clock offsets must be a mapping from quantities, but got 0.1"),
    ):
        with pytest.raises(ValueError, match=said):
            ReplayEnv(log, MODEL, **options)
