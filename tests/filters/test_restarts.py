"""Restarts are told: how many, the first step and states, and the likely cause, on every path."""

import json
import math
import pickle
import warnings
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest

import filters
from filters import EstimateState, RestartWarning, make_filter, restarts_of
from filters.logs.estimate import estimate_with
from filters.logs.findings import findings, verdict
from filters.wrappers.envs import EstimateStates
from tests.models import affine, state_space
from thruster_env.env.model_env import ModelEnv, Split
from thruster_env.logs.log import Log
from tuning.evaluation.evaluate import evaluate, restart_sentences
from tuning.evaluation.held_out import Comparison, summarised, summary
from tuning.problems.data import Data
from tuning.problems.model_problem import RunsProblem

pytestmark = pytest.mark.usefixtures("as_python")


class Clock(NamedTuple):
    """The constants of a model of any step length."""

    dt: float


def model(**changes):
    """Two states, the second one driven by the input; each change makes it fail where x_2 is beyond 5."""
    return state_space(
        lambda x, u, c: (0.9 * x[0], x[1] + u[0]),
        lambda x, c: (x[0] + x[1],),
        q=[0.1, 0.1],
        r=[100.0],
        mean=[0.0, 0.0],
        cov=[1.0, 0.01],
        **{"inputs": 1, "states": [("first", "a", "m"), ("second", "b", "m")], **changes},
    )


def lost_f(x, u, c):
    """NaN beyond 5."""
    return 0.9 * x[0], x[1] + u[0] if x[1] < 5.0 else math.nan


def jacobian_of_f(x, u, c):
    """NaN beyond 5."""
    return (0.9, 0.0), (0.0, 1.0 + 0.0 * math.sqrt(5.0 - x[1]) if x[1] < 5.0 else math.nan)


def jacobian_of_h(x, c):
    """NaN beyond 5."""
    return ((1.0, 1.0 if x[1] < 5.0 else math.nan),)


FAILING = {
    "f(x, u) is NaN": (("b",), {"transition": lost_f}),
    "f(x, u) is infinite, it overflows": (
        ("a",),
        {"transition": lambda x, u, c: (0.9 * x[0] if x[1] < 5.0 else math.inf, x[1] + u[0])},
    ),
    "F = df/dx is NaN": (("b",), {"transition_jacobian": jacobian_of_f}),
    "h(x) is NaN": (("a", "b"), {"observe": lambda x, c: (x[0] + x[1] if x[1] < 5.0 else math.nan,)}),
    "H = dh/dx is NaN": (("b",), {"observe_jacobian": jacobian_of_h}),
}


def data(count=1, lost=0):
    """Inputs that drive the second state beyond 5 at step 3 of one run, and measurements that follow."""
    inputs = np.zeros((count, 6, 1))
    inputs[lost, 1:3] = 4.0
    measurements = np.concatenate([np.zeros((count, 1, 1)), np.cumsum(inputs, axis=1)], axis=1)
    return inputs, measurements


@pytest.mark.parametrize("cause", FAILING)
def test_the_first_step_states_and_cause_are_told(cause):
    states, changes = FAILING[cause]
    filter_, (inputs, z) = make_filter("ekf", model(**changes)), data(3, lost=1)
    with pytest.warns(RestartWarning, match="in 1 of 3 runs, first at step .* of run 1") as caught:
        found = filters.run(filter_, None, inputs, z)
    told = restarts_of(filter_, found.divergences, None, inputs, z)
    assert told.cause == cause and told.states == states and told.sentence == str(caught[0].message)
    assert (told.times, told.runs, told.of_runs, told.run) == (found.divergences.sum(), 1, 3, 1)
    assert told.step == (3 if cause.startswith(("h", "H")) else 4)
    assert pickle.loads(pickle.dumps(told)) == told


def test_without_restarts_nothing_is_told():
    filter_, (inputs, z) = make_filter("ekf", model()), data()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = filters.run(filter_, None, inputs, z)
    assert restarts_of(filter_, found.divergences, None, inputs, z) is None


def test_a_covariance_that_overflows_is_told_and_so_are_noises_of_each_step():
    filter_ = make_filter("kf", affine([[1.0]], [[1.0]], [[1.0]], q=[0.1], r=[1.0], mean=[0.0], cov=[1.0]))
    inputs, z = np.zeros((1, 4, 1)), np.full((1, 5, 1), np.nan)
    q = np.full((4, 1, 1), 0.1)
    q[2] = 1e305
    with pytest.warns(RestartWarning):
        found = filters.run(filter_, None, inputs, z, process_noise_covs=q)
    told = restarts_of(filter_, found.divergences, None, inputs, z, process_noise_covs=q)
    assert told.step == 3


def test_logs_wrappers_and_evaluations_tell_the_same():
    cause = "F = df/dx is NaN"
    filter_, (inputs, z) = make_filter("ekf", model(**FAILING[cause][1])), data()
    names = filter_.model
    log = Log("log", 1.0, inputs[0], z[0], names.input_quantities, names.measurements)
    found = estimate_with(filter_, log)
    assert found.restarts.cause == cause and found.restarts.step == 4
    assert found.restarts.sentence in verdict(found, findings(found, 0))
    env = EstimateState(ModelEnv(model(), model, low=-9.0, high=9.0, dt=1.0), filter_)
    _, info = env.reset(seed=0)
    assert "estimate_restarts" not in info
    for u in inputs[0]:
        *_, info = env.step(u)
    assert cause in info["estimate_restarts"] and "first at step" in info["estimate_restarts"]
    runs = Data((0, 1), *data(2, lost=1), np.zeros((2, 2)), 0)
    evaluation = evaluate(filter_, runs, None)
    assert evaluation.restarts.run == 1 and evaluation.restarts.cause == cause
    assert restart_sentences({"ekf": evaluation, "other": evaluation._replace(restarts=None)}) == [
        f"ekf: {evaluation.restarts.sentence}"
    ]


def one_env(filter_):
    """An env whose input drives the second state, with the filter beside it."""
    return EstimateState(ModelEnv(model(), model, low=-9.0, high=9.0, dt=1.0), filter_)


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP"])
@pytest.mark.parametrize("cause", FAILING)
def test_copies_of_a_vector_env_tell_what_single_ones_do_at_the_steps_where_it_happens(cause, mode):
    filter_, (inputs, _) = make_filter("ekf", model(**FAILING[cause][1])), data(3, lost=1)
    envs = gym.vector.SyncVectorEnv(
        [lambda: ModelEnv(model(), model, low=-9.0, high=9.0, dt=1.0) for _ in range(3)],
        autoreset_mode=gym.vector.AutoresetMode[mode],
    )
    copies, singles = EstimateStates(envs, filter_), [one_env(filter_) for _ in range(3)]
    _, info = copies.reset(seed=5)
    assert "estimate_restarts" not in info
    counts = np.zeros(3)
    for i, one in enumerate(singles):
        one.reset(seed=5 + i)
    for k in range(6):
        *_, info = copies.step(inputs[:, k])
        of_singles = [one.step(inputs[i, k])[-1] for i, one in enumerate(singles)]
        new = [one["estimate_divergences"] > before for one, before in zip(of_singles, counts, strict=True)]
        counts = np.array([one["estimate_divergences"] for one in of_singles])
        assert ("estimate_restarts" in info) == any(new)
        if any(new):
            np.testing.assert_array_equal(info["_estimate_restarts"], new)
            expected = [one.get("estimate_restarts") if new[i] else None for i, one in enumerate(of_singles)]
            assert info["estimate_restarts"].tolist() == expected and cause in expected[1]
    assert counts[1] and not counts[[0, 2]].any()
    _, info = copies.reset(seed=5)
    assert "estimate_restarts" not in info


@pytest.mark.parametrize("cause", FAILING)
def test_real_clocks_tell_the_same_and_logs_by_them(cause):
    states, changes = FAILING[cause]
    clocked = model(**changes, constants=Clock(1.0), states=model().states)
    filter_, (inputs, z) = make_filter("ekf", clocked), data()
    live = filter_.live()
    live.start(7.0, z[0, 0])
    for k, u in enumerate(inputs[0], 1):
        assert k > 3 or live.restarts is None
        live.predict_to(7.0 + k, u)
        live.update(7.0 + k, None, z[0, k])
    step = 3 if cause.startswith(("h", "H")) else 4
    assert live.restarts.times == live.divergences >= 1
    assert live.restarts[4:] == (step, states, cause)
    live.start(0.0, z[0, 0])
    assert live.restarts is None
    log = Log("log", 1.0, inputs[0], z[0], clocked.input_quantities, clocked.measurements, stamps=np.arange(7.0))
    assert estimate_with(filter_, log).restarts[4:] == (step, states, cause)


def test_the_noise_and_dt_that_a_session_was_set_to_are_those_of_the_cause():
    def transition(x, u, c):
        return 0.9 * x[0], x[1] + u[0] + (math.inf if c.dt > 1.5 else 0.0)

    live = make_filter("ekf", model(transition=transition, constants=Clock(2.0))).live()
    live.start(0.0)
    live.predict_to(1.0, [0.0])
    live.update(1.0, None, [0.0])
    assert live.restarts is None
    live.predict_to(3.0, [0.0])
    live.update(3.0, None, [0.0])
    assert live.restarts[4:] == (2, ("b",), "f(x, u) is infinite, it overflows")


def test_measured_inputs_are_known_to_the_cause():
    def split(self, model):
        return Split(inputs=(1,), measurements=(0,), channels=2)

    class Copies(gym.vector.SyncVectorEnv):
        measured_inputs = split

    class Measuring(ModelEnv):
        """Two channels, of which the second is an input of the model."""

        def __init__(self):
            super().__init__(model(), model, low=-9.0, high=9.0, dt=1.0)
            self.observation_space = gym.spaces.Box(-np.inf, np.inf, shape=(2,), dtype=np.float32)

        measured_inputs = split

        def reset(self, **given):
            observation, info = super().reset(**given)
            info["measurement"] = np.array([0.0, 4.0])
            return np.zeros(2, dtype=np.float32), info

        def step(self, action):
            *_, info = super().step(action)
            info["measurement"] = np.array([0.0, 4.0])
            return np.zeros(2, dtype=np.float32), 0.0, False, False, info

    def transition(x, u, c):
        return 0.9 * x[0], x[1] + u[1] if x[1] < 5.0 else math.nan

    filter_ = make_filter("ekf", model(transition=transition, inputs=2))
    single, copies = (EstimateState(Measuring(), filter_), EstimateStates(Copies([Measuring, Measuring]), filter_))
    told = []
    for env, action in ((single, [0.0]), (copies, np.zeros((2, 1)))):
        env.reset(seed=0)
        infos = [env.step(action)[-1] for _ in range(4)]
        told.append(next(one["estimate_restarts"] for one in infos if "estimate_restarts" in one))
    assert "(b): f(x, u) is NaN." in told[0] and told[1].tolist() == [told[0]] * 2


def test_reports_tell_them_also_of_stored_evaluations():
    filter_, (inputs, z) = make_filter("ekf", model(**FAILING["F = df/dx is NaN"][1])), data(2, lost=1)
    runs = [(u, 0.1 + rows + i) for i in range(3) for u, rows in zip(inputs, z, strict=True)]
    problem = RunsProblem(runs, filter_.model, first_scored_step=1, held_out=[0, 1])
    found = evaluate(filter_, Data((0, 1), inputs, z, np.zeros((2, 2)), 1), None)
    stored = summarised(json.loads(json.dumps(summary(found))), problem)
    assert stored.restarts == found.restarts and stored.divergences == found.divergences
    quiet = found._replace(restarts=None)
    assert "restarts" not in summary(quiet) and summarised(summary(quiet), problem).restarts is None
    comparison = Comparison(quiet, found, None, bound=np.full(2, np.nan), seeds=range(1, 2))
    page = " ".join(restart_sentences(comparison.evaluations))
    assert f"tuned: {found.restarts.sentence}" in page and page.count("restarted from the prior") == 1


@pytest.mark.parametrize("name", ["imm", "mmae"])
@pytest.mark.parametrize("place", [0, 1])
@pytest.mark.parametrize("cause", FAILING)
def test_a_mode_that_begins_anew_counts_and_is_named(cause, place, name):
    states, changes = FAILING[cause]
    modes = [model(), model()]
    modes[place] = model(**changes)
    filter_, (inputs, z) = make_filter(name, model(), modes=modes, mode_filter="ekf"), data(2, lost=1)
    with pytest.warns(RestartWarning, match="in 1 of 2 runs"):
        found = filters.run(filter_, None, inputs, z)
    assert np.isfinite(found.means).all()
    told = restarts_of(filter_, found.divergences, None, inputs, z)
    assert told[4:] == (3 if cause.startswith(("h", "H")) else 4, states, f"{cause} in modes[{place}]")
    session = filter_.session()
    session.start((0, 0), np.full(1, np.nan))
    for u in inputs[1]:  # where nothing is measured, too
        session.step(u, np.full(1, np.nan))
    assert (session.divergences > 0) == (not cause.startswith(("h", "H")))


SMOOTHED = {"ekf": {}, "ukf": {}, "enkf": {"ensemble_size": 20}, "imm": {"mode_filter": "ekf"}}


@pytest.mark.parametrize("lag", [None, 2])
@pytest.mark.parametrize("name", SMOOTHED)
def test_a_smoother_warns_as_the_filter_does(name, lag):
    failing, numbers = model(transition=lost_f), SMOOTHED[name]
    numbers = numbers if name != "imm" else {**numbers, "modes": [failing, model()]}
    filter_, (inputs, z) = make_filter(name, failing, **numbers), data(2, lost=1)
    with pytest.warns(RestartWarning) as of_run:
        filters.run(filter_, None, inputs, z)
    if name == "imm":
        with pytest.warns(RestartWarning) as caught:
            filters.smooth_modes(filter_, None, inputs, z)
    else:
        with pytest.warns(RestartWarning) as caught:
            filters.smooth(filter_, None, inputs, z, lag)
    assert [str(one.message) for one in caught] == [str(one.message) for one in of_run]
    assert caught[0].filename == __file__


def test_runs_that_begin_where_they_are_measured_are_repeated_from_there():
    inputs, z = data(2, lost=1)
    runs = [(u, 0.1 + 0.01 * i + rows) for i in range(3) for u, rows in zip(inputs, z, strict=True)]
    failing = model(**FAILING["f(x, u) is NaN"][1])
    problem = RunsProblem(runs, failing, start="measurement", held_out=[0, 1])
    assert (problem.model().prior_cov != failing.prior_cov).any()
    found = evaluate(make_filter("ekf", problem.model()), problem.data(range(6)), None)
    assert found.divergences and found.restarts.cause == "f(x, u) is NaN" and found.restarts.states == ("b",)
