"""An infinite measurement, or an input that is not finite, is refused on every path, and changes nothing."""

import gymnasium as gym
import numpy as np
import pytest

import filters
from filters import EstimateState, EstimateStates, make_filter, run, smooth
from filters.engine.batch import Beliefs
from tests.models import state_space
from thruster_env.core.streams import filter_keys

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
        with pytest.raises(ValueError, match=FINITE):
            session.step([u], [z])
    assert session.divergences == 0
    for one in (session, other):
        one.step([0.3], [np.nan])
    assert session.mean == other.mean and session.cov == other.cov


@pytest.mark.parametrize("u, z", WRONG)
def test_runs_of_many_and_single_steps_refuse_it(u, z, as_python):
    filter_, (inputs, measurements) = make_filter("ekf", line()), last(u, z)
    with pytest.raises(ValueError, match=FINITE):
        run(filter_, filter_keys([0]), inputs, measurements)
    with pytest.raises(ValueError, match=FINITE):
        smooth(filter_, filter_keys([0]), inputs, measurements)
    belief = filter_.init(KEY)
    with pytest.raises(ValueError, match=FINITE):
        filter_.update(filter_.predict(belief, [u]), [z])
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
    with pytest.raises(ValueError, match=FINITE):
        filter_.run(*last(u, z))
    with pytest.raises(ValueError, match=FINITE):
        filter_.update(filter_.predict(filter_.init(), [u]), [z])


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
            with pytest.raises(ValueError, match=FINITE):
                live.update(0.7, None, [np.inf])
            with pytest.raises(ValueError, match=FINITE):
                live.predict_to(0.7, [np.nan])
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
        with pytest.raises(ValueError, match="must be 1 number, each finite or NaN, but got .*inf"):
            env.step(action)
