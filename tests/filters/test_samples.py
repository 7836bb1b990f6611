"""Samples that are missing, in any form, and infinite ones, on every path."""

import math

import gymnasium as gym
import numpy as np
import pytest

import filters
from filters import EstimateState, EstimateStates, make_filter, run, smooth
from filters.engine.batch import Beliefs
from filters.sensitivity import likelihood
from tests.filters.checks import refused
from tests.kalman_by_hand import LinearModel
from tests.models import line_model, simulated, small, state_space, wide_model
from thruster_env.core.checks import as_floats
from thruster_env.core.streams import filter_keys
from thruster_env.logs.log import Log

FINITE, KEY = "must be .*finite", (0, 0)
WRONG = [(0.3, np.inf), (0.3, -np.inf), (np.inf, 1.0), (np.nan, 1.0)]  # u, z


def follows(x, u, c):
    return (0.9 * x[0] + c[0] * u[0],)


def line(**changes):
    model = state_space(
        follows, lambda x, c: (x[0],), q=[0.1], r=[0.1], mean=[0.0], cov=[1.0], inputs=1, constants=(0.1,)
    )
    return model.replace(**changes)


def last(u, z):
    """Inputs (1, 2, 1) and measurements (1, 3, 1) that end with u and z."""
    return np.array([[[0.3], [u]]]), np.array([[[0.1], [0.2], [z]]])


@pytest.mark.parametrize("u, z", WRONG)
@pytest.mark.parametrize("options", [{}, {"gate": 3.0}])
def test_a_session_refuses_it_and_goes_on_from_where_it_was(u, z, options, as_python):
    filter_ = make_filter("ekf", line())
    session, other = filter_.session(**options), filter_.session(**options)
    for one in (session, other):
        one.start(KEY, [0.1])
    for _ in range(2):
        refused(FINITE, session.step, [u], [z])
    assert session.divergences == 0
    for one in (session, other):
        one.step([0.3], [np.nan])
    assert session.mean == other.mean and session.cov == other.cov


@pytest.mark.parametrize("u, z", WRONG)
def test_runs_of_many_and_single_steps_refuse_it(u, z, as_python):
    filter_, (inputs, measurements) = make_filter("ekf", line()), last(u, z)
    refused(FINITE, run, filter_, filter_keys([0]), inputs, measurements)
    refused(FINITE, smooth, filter_, filter_keys([0]), inputs, measurements)
    belief = filter_.init(KEY)
    refused(FINITE, lambda: filter_.update(filter_.predict(belief, [u]), [z]))
    beliefs = Beliefs(filter_, 2)
    beliefs.start(np.arange(2), np.zeros((2, 2)), np.array([[0.1], [0.2]]))
    before = beliefs.part("mean")
    with pytest.raises(ValueError, match="of copy 1 must be 1 number, each finite"):
        beliefs.step(np.array([[0.3], [u]]), np.array([[0.2], [z]]))
    np.testing.assert_array_equal(beliefs.part("mean"), before)
    beliefs.step(np.array([[0.3], [u]]), np.array([[0.2], [z]]), idle=np.array([False, True]))


@pytest.mark.parametrize("u, z", WRONG)
def test_tensors_refuse_it(u, z):
    pytest.importorskip("torch")
    filter_ = filters.torch(make_filter("ekf", line()))
    refused(FINITE, filter_.run, *last(u, z))
    refused(FINITE, lambda: filter_.update(filter_.predict(filter_.init(), [u]), [z]))


def moves(x, u, c):
    return (x[0] + c.dt * u[0],)


def test_a_live_filter_refuses_it_and_puts_late_samples_in_order_after_it(as_python):
    from typing import NamedTuple

    constants = NamedTuple("Constants", [("dt", float)])(0.1)
    filter_, found = make_filter("ekf", line(constants=constants, transition=moves)), []
    for wrong in (False, True):
        live = filter_.live(late=1.0)
        live.start(0.0, [0.1])
        live.predict_to(0.5, [0.3])
        if wrong:
            refused(FINITE, live.update, 0.7, None, [np.inf])
            refused(FINITE, live.predict_to, 0.7, [np.nan])
        live.update(0.6, None, [0.4])
        live.update(0.55, None, [0.2])
        found.append((live.time, *live.mean, *live.cov[0]))
    assert found[0] == found[1]


class Sensor(gym.Env):
    """A state at rest, whose third measurement is infinite."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.array([0.1]), {}

    def step(self, action):
        self.steps += 1
        return np.array([np.inf if self.steps == 2 else 0.1]), 0.0, False, False, {}


def test_wrappers_refuse_it(as_python):
    many = gym.vector.SyncVectorEnv([Sensor] * 2)
    for env in (EstimateState(Sensor(), "ekf", model=line()), EstimateStates(many, "ekf", model=line())):
        env.reset(seed=1)
        action = np.zeros(env.action_space.shape)
        env.step(action)
        refused("must be 1 number, each finite or NaN, but got .*inf", env.step, action)


INPUTS, MEASUREMENTS = simulated(line_model(), 10, seed=3)
LOST = np.random.default_rng(2).random(MEASUREMENTS.shape) < 0.4
PLAIN = np.where(LOST, np.nan, MEASUREMENTS)


class NAType:
    """What pandas.NA is where pandas is not installed."""


def objects(missing):
    found = MEASUREMENTS.astype(object)
    found[LOST] = missing
    return found


FORMS = {
    "masked": np.ma.masked_array(np.where(LOST, -24000.0, MEASUREMENTS), LOST),
    "masked objects": np.ma.masked_array(np.where(LOST, 1e9, MEASUREMENTS).astype(object), LOST),
    "list of masked rows": list(np.ma.masked_array(np.where(LOST, 1e9, MEASUREMENTS), LOST)),
    "nested masked rows": [[*np.ma.masked_array(np.where(LOST[0], 1e9, MEASUREMENTS[0]), LOST[0])]],
    "None": objects(None),
    "lists with None": objects(None).tolist(),
    "NA": objects(NAType()),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("path", ["run", "session", "update", "smooth", "likelihood", "log"])
def test_what_is_missing_is_nan(path, form, as_python):
    filter_, key = small("ekf", line_model()), filter_keys([0])

    def means(z):
        if path == "run":
            return run(filter_, key, INPUTS, z).means
        if path == "session":
            session = filter_.session()
            session.start((0, 0), z[0][0])
            for u, one in zip(INPUTS[0], z[0][1:], strict=True):
                session.step(u, one)
            return session.mean
        if path == "update":
            return [filter_.update(filter_.init((0, 0)), one)[0].mean for one in z[0]]
        if path == "smooth":
            return smooth(filter_, key, INPUTS, z).means
        if path == "likelihood":
            slopes = np.zeros((1, 2, 2)), np.zeros((1, 1, 1))
            return likelihood(filter_.model, INPUTS, z, *slopes, filter=filter_).values
        model = filter_.model
        return Log("run", 0.1, INPUTS[0], z[0], model.input_quantities, model.measurements).measurements

    np.testing.assert_array_equal(means(FORMS[form]), means(PLAIN))


@pytest.mark.parametrize("form", FORMS)
def test_tensors_know_what_is_missing(form, as_python):
    torch = pytest.importorskip("torch")
    filter_ = filters.torch(small("ekf", line_model()))
    found, expected = (filter_.run(INPUTS, z) for z in (FORMS[form], PLAIN))
    assert torch.equal(found.means, expected.means) and not torch.isnan(found.means).any()


def test_none_alone_and_text_are_no_numbers():
    for value in (None, "1.0", ["1.0", None], [[1.0], None, "x"], 1j, np.ma.masked_array(["1"], [True])):
        refused("an array must be one of numbers", as_floats, value)
    np.testing.assert_array_equal(as_floats([1, None, np.ma.masked, 2.5]), [1.0, np.nan, np.nan, 2.5])


@pytest.mark.parametrize("missing", [None, np.ma.masked, math.nan, NAType()])
def test_live_takes_a_single_sample_that_is_missing(missing, as_python):
    live = make_filter("ekf", LinearModel(np.random.default_rng(0)).model()).live()
    live.start(0.0)
    before = live.mean.copy()
    live.update(0.0, "z0", missing)
    np.testing.assert_array_equal(live.mean, before)


@pytest.mark.parametrize("z", [[1.0], [[1.0, 2.0]], [1.0, 2.0, 3.0], 1.0])
def test_a_session_takes_one_number_a_channel(z, as_python):
    session = small("ekf", wide_model()).session()
    refused("z must be 2 numbers", session.start, (0, 0), z)
    session.start((0, 0), [1.0, 2.0])
    refused("z must be 2 numbers", session.step, [0.1, 0.2], z)
