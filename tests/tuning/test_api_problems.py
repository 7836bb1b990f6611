"""What a user may give for a problem: names, problems, and pairs of a model and recorded runs in any form."""

import dataclasses

import gymnasium as gym
import numpy as np
import pandas
import pytest

import thruster_env  # noqa: F401 - registers the env
import tuning
from filters import EstimateState
from tests.filters.checks import refused
from tests.models import affine
from tests.pendulum_problem import problem as pendulum
from tests.small_problems import pair
from thruster_env.logs.log import Log
from thruster_env.logs.write import write_log
from thruster_env.model.simulate import simulate
from tuning.api.problems import problem_of, problems_of
from tuning.problems.assumed import may_estimate_constants
from tuning.problems.excitation import Dwells, Levels, MultiSine, Steps
from tuning.problems.find import find_problem
from tuning.problems.log_problem import LogProblem


def cart(dt=0.1):
    quantities = {"states": [("place", "p", "m"), ("speed", "v", "m/s")], "measurements": [("tape", "z", "m")]}
    noise = {"q": [1e-4, 1e-3], "r": [1e-2], "mean": [0.0, 0.0], "cov": [1.0, 1.0]}
    of_input = {"input_quantities": [("push", "F", "N")]}
    return affine([[1.0, dt], [0.0, 0.9]], [[0.0], [dt]], [[1.0, 0.0]], **noise, **quantities, **of_input)


@pytest.fixture(scope="module")
def logs():
    """Two runs of the cart without their true states."""
    model, runs = cart(), []
    pushes = np.sin(0.3 * np.arange(240))[None, :, None] * [[[1.0]], [[2.0]]]
    found = simulate(model, np.array([[1.0, 2.0], [3.0, 4.0]]), pushes)
    for place in range(2):
        parts = pushes[place], found.measurements[place], model.input_quantities, model.measurements
        runs.append(Log(f"log {place}", 0.1, *parts))
    return runs


def table_of(log):
    """A log as columns by header."""
    push = np.append(log.inputs[:, 0], np.nan)
    return {"time_s": log.times, "push_N": push, "tape_m": log.measurements[:, 0]}


def test_recorded_runs_are_the_same_in_any_form(logs, tmp_path):
    columns = [table_of(log) for log in logs]
    frames = [pandas.DataFrame(one) for one in columns]
    stamps = [pandas.to_datetime(frame.time_s, unit="s").dt.round("ms") for frame in frames]
    dated = [frame.drop(columns="time_s").set_index(stamp) for frame, stamp in zip(frames, stamps, strict=True)]
    indexed = [frame.set_index("time_s") for frame in frames]
    paths = [tmp_path / f"{place}.csv" for place in range(2)]
    for path, log in zip(paths, logs, strict=True):
        write_log(path, log)
    wanted = problem_of((cart(), logs)).data(range(4))
    for data in (columns, frames, indexed, dated, paths, list(map(str, paths))):
        found = problem_of(tuning.read_logs(data, model=cart, lead=20))
        assert isinstance(found, LogProblem) and len(found.logs) == 2
        got = problem_of((cart(), data)).data(range(4))
        np.testing.assert_allclose(got.measurements, wanted.measurements, rtol=1e-12)
        np.testing.assert_allclose(got.inputs, wanted.inputs, rtol=1e-12)
    assert [log.name for log in problem_of((cart(), columns)).logs] == ["run1", "run2"]
    assert [log.name for log in problem_of((cart(), logs)).logs] == ["log 0", "log 1"]
    named = problem_of(tuning.read_logs(frames, model=cart(), held_out="run2"))
    assert named.parts.held_out != problem_of((cart(), frames)).parts.held_out


def test_tuning_on_a_model_and_frames_finds_a_filter(logs):
    frames = [pandas.DataFrame(table_of(log)) for log in logs]
    study = tuning.tune(tuning.read_logs(frames, model=cart(), lead=20), "kf", trials=3, progress=False)
    assert study.plan.objectives == ("likelihood",) and "log-likelihood" in repr(study)
    assert study.problem.name == "run1 and 1 more" and study.filter.name == "kf"
    estimates = tuning.estimate((cart(), frames[0]), study)
    assert estimates.filter.name == "kf" and np.isfinite(estimates.means).all()
    assert "log-likelihood" in study.held_out.to_frame().columns
    assert "log-likelihood" in repr(study.held_out) and "nan" not in study._repr_html_()
    refused("a figure of errors needs the truth", study.plot_errors)


def test_columns_with_true_states_are_the_truth():
    problem = find_problem("nominal")
    data = problem.data([5])
    states, inputs = data.states[0], np.append(data.inputs[0, :, 0], np.nan)
    table = {"time_s": 0.01 * np.arange(len(states)), "V_s": inputs}
    table["measured_thrust_N"] = data.measurements[0, :, 0]
    table |= {"omega_m": states[:, 0], "U_a": states[:, 1]}
    found = problem_of(("tunnel", table))
    assert found.scale is not None and found.data([0]).states is not None
    assert problem_of(("tunnel", {k: v for k, v in table.items() if k not in ("omega_m", "U_a")})).scale is None


def test_problems_by_name_and_themselves():
    assert problem_of("mismatch").name == "mismatch" and problem_of("auv:motion").name == "auv:motion"
    mine = pair()
    assert problem_of(mine) is mine
    assert [one.name for one in problems_of(["nominal", "mismatch"])] == ["nominal", "mismatch"]
    assert problem_of("nominal", preset="tunnel_physical").name == "nominal (tunnel_physical)"


WRONG = [
    (lambda: problem_of(3), "a problem must be a name, .* of a model and recorded runs, but got 3"),
    (lambda: problems_of([]), "or a list of them, but got an empty list"),
    (lambda: problem_of(("tunnel", "x.csv"), preset="t200"), "preset must be given to read_logs, but got 't200'"),
    (lambda: problem_of((cart(), 5)), "a log must be the path of a file, a pandas.DataFrame, .* but got 5"),
    (lambda: problem_of((cart(), [])), "a problem of logs must have at least one"),
    (lambda: problem_of((cart(), {"a": np.zeros(3)})), "a log must have a column for the input"),
    (lambda: problem_of((cart(), {"F": np.zeros(3), "z": np.zeros(2)})), "columns of equal length .*, but run1"),
    (lambda: problem_of((5, {"F": np.zeros(3)})), "the model of a log must be a StateSpaceModel, .* but got 5"),
    (lambda: problem_of((cart(), "none.csv")), "none.csv is not"),
    (
        lambda: problem_of(tuning.read_logs({"z": np.zeros(9)}, model=cart(), columns=5)),
        r"columns \(--column\) must be a mapping by name, .* but got 5",
    ),
]


@pytest.mark.parametrize("call, said", WRONG)
def test_errors_state_the_rule_and_the_value(call, said):
    refused(said, call)


def test_two_logs_of_one_name_are_told_apart(logs):
    with pytest.raises(ValueError, match="logs must have different names, but got two called log 0"):
        problem_of((cart(), [logs[0], logs[1].named("log 0")]))
    with pytest.raises(ValueError, match="dt must come with a file or a table, but log 0 is a Log already"):
        problem_of(tuning.read_logs(logs, model=cart(), dt=0.2))


@pytest.mark.parametrize("noise", [None, (0.01, 0.02, 0.25)], ids=["exact", "noisy"])
def test_an_env_of_a_users_env_offers_the_problems_model_and_makes_its_data(noise):
    problem = pendulum(measurement_noise_cov=noise)
    data, wrapped = problem.data([3]), EstimateState(gym.wrappers.TimeLimit(problem.make_env(), 50), "ekf")
    assert wrapped.filter.model.states == problem.model().states
    for _ in range(2):  # once more from the same seed
        _, info = wrapped.reset(seed=3)
        for k in range(10):
            np.testing.assert_allclose(info["measurement"], data.measurements[0, k], rtol=1e-12)
            np.testing.assert_allclose(info["state"], data.states[0, k], rtol=1e-12)
            info = wrapped.step(data.inputs[0, k])[4]
    _, other = wrapped.reset()
    assert (other["measurement"] != info["measurement"]).all()


@pytest.mark.parametrize(
    ("inputs", "low", "high"),
    [
        (Steps(amplitude=(1.0, 2.0)), [-1.0, -2.0], [1.0, 2.0]),
        (Levels(low=-3.0, high=(1.0, 2.0)), [-3.0, -3.0], [1.0, 2.0]),
        (MultiSine(amplitude=2.0, offset=(1.0, -1.0)), [-5.0, -7.0], [7.0, 5.0]),
        (Dwells(amplitude=4.0), [-4.0, -4.0], [4.0, 4.0]),
        (np.linspace([-1.0, 5.0], [3.0, 5.0], 60), [-1.0, -np.inf], [3.0, np.inf]),
        (lambda seeds, steps: np.zeros((len(seeds), steps, 2)), [-np.inf] * 2, [np.inf] * 2),
    ],
)
def test_actions_of_a_models_env_are_within_what_the_problem_applies(inputs, low, high):
    problem = pair(inputs=inputs)
    space, applied = problem.make_env().action_space, problem.data([1, 2]).inputs
    assert space.low.tolist() == low and space.high.tolist() == high
    assert (applied >= space.low).all() and (applied <= space.high).all()
    assert problem.make_env(high=9.0).action_space.high.tolist() == [9.0, 9.0]


def test_a_reset_without_info_is_said():
    class Bare(gym.Wrapper):
        def reset(self, **options):
            return super().reset(**options)[0]

    bare, options = Bare(gym.make("Pendulum-v1").unwrapped), {"steps": 60, "has_truth": False}
    problem = pendulum().__class__(bare, "random", pendulum().model(), **options)
    refused(r"must return \(observation, info\), but returned", problem.data, [1])


def test_envs_of_other_problems(logs):
    mine = pair()
    env, data = mine.make_env(low=-9.0, high=9.0), mine.data([2])
    _, info = env.reset(seed=2)
    np.testing.assert_allclose(info["measurement"], data.measurements[0, 0], rtol=1e-12)  # another program
    assert type(mine.env()) is type(env)  # the name that it had
    swinging = pendulum().make_env(g=9.0)
    assert isinstance(swinging, gym.Env) and swinging.unwrapped.g == 9.0
    recorded = problem_of((cart(), logs))
    replayed = EstimateState(recorded.make_env(run=1), "kf")
    assert replayed.unwrapped.log.name == logs[1].name and replayed.reset()[0].shape == (2,)
    refused("run must be at most 1, but got 2", recorded.make_env, run=2)
    refused("must come with run alone, but got low", recorded.make_env, low=1.0)


def test_outliers_in_logs_name_the_filter_and_constants_without_names_stay_as_they_are(logs):
    assert not any("ekf-robust" in sentence for sentence in LogProblem(logs, cart()).remarks)
    values = logs[0].measurements.copy()
    values[100] += 9.0
    wild = dataclasses.replace(logs[0], measurements=values)
    sentences = LogProblem([wild, logs[1]], cart()).remarks
    assert "1 isolated outlier in row 100" in sentences[0] and "--filter ekf-robust" in sentences[1]
    assert may_estimate_constants(find_problem("nominal"))
    assert not may_estimate_constants(LogProblem(logs, cart()))
