"""What a masked array masks is missing: its fill value is nobody's sample."""

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

from filters import EstimateState, EstimateStates, make_filter, run
from filters.sensitivity import likelihood
from tests.models import KEY, line_model, simulated, wide_model
from tests.thruster_env.logs.test_logs import MODEL
from thruster_env.core.checks import as_floats, vector
from thruster_env.core.streams import filter_keys
from thruster_env.env.model_env import ReplayEnv
from thruster_env.logs.log import Log
from thruster_env.logs.read import read_log
from thruster_env.model.simulate import simulate
from tuning.problems.check import check_data
from tuning.problems.data import Data
from tuning.problems.env_problem import EnvProblem
from tuning.problems.model_problem import ModelProblem

pytestmark = pytest.mark.usefixtures("as_python")
BEHIND = 1e6  # what stands behind the mask


def masked(values, where):
    """The same numbers with a mask, and with something else behind it."""
    return np.ma.masked_array(np.where(where, BEHIND, values), where, fill_value=7.0)


def missing(values):
    """A fifth of the entries, and the values with NaN there."""
    where = np.random.default_rng(3).random(values.shape) < 0.2
    return where, np.where(where, np.nan, values)


@pytest.mark.parametrize("kind", [np.float64, np.float32, int, bool])
def test_as_numbers_they_are_nan(kind):
    given = np.ma.masked_array(np.ones(3, dtype=kind), [False, True, False])
    np.testing.assert_array_equal(as_floats(given), [1.0, np.nan, 1.0])
    assert type(as_floats(given)) is np.ndarray
    with pytest.raises(ValueError, match="must be 3 finite numbers"):
        vector("x", given, 3)
    with pytest.raises(ValueError, match="must be one of numbers"):
        as_floats(np.ma.masked_array(["1", "2"], [False, True]))


@pytest.mark.parametrize("make", [line_model, wide_model])
def test_filters_take_them_as_missing_on_all_paths(make):
    model, filter_ = make(), make_filter("ekf", make())
    inputs, measurements = simulated(model, 12)
    where, plain = missing(measurements)
    hidden = masked(measurements, where)
    expected = run(filter_, filter_keys([0]), inputs, plain)
    for one, other in zip(run(filter_, filter_keys([0]), inputs, hidden), expected, strict=True):
        np.testing.assert_array_equal(one, other)
    belief, session = filter_.init(KEY), filter_.session()
    for k in range(len(plain[0])):
        if k:
            belief = filter_.predict(belief, inputs[0, k - 1])
            session.step(inputs[0, k - 1], hidden[0, k])
        else:
            session.start(KEY, hidden[0, 0])
        belief, _ = filter_.update(belief, hidden[0, k])
        np.testing.assert_allclose(belief.mean, expected.means[0, k], rtol=1e-12)
        np.testing.assert_allclose(session.mean, expected.means[0, k], rtol=1e-12)
    with pytest.raises(ValueError, match="u must be .* each finite"):
        session.step(np.ma.masked_all(model.inputs), plain[0, 0])
    with pytest.raises(ValueError, match="must be finite|must not be NaN|finite"):
        run(filter_, filter_keys([0]), masked(inputs, np.ones(inputs.shape, dtype=bool)), plain)
    slopes = np.zeros((1, model.n, model.n)), np.zeros((1, model.m, model.m))
    for one, other in zip(
        likelihood(model, inputs, hidden, *slopes), likelihood(model, inputs, plain, *slopes), strict=True
    ):
        np.testing.assert_array_equal(one, other)


class Sensor(gym.Env):
    """A state that drifts, seen by an observation that is masked every third step."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def __init__(self, way="masked", place="observation"):
        self.way, self.place, self.step_number = way, place, 0

    def _seen(self):
        where = np.array([self.step_number % 3 == 1, False])
        z = np.array([0.3, 0.1]) * self.step_number
        z = masked(z, where) if self.way == "masked" else np.where(where, np.nan, z)
        info = {"state": np.zeros(2)}
        return (z, info) if self.place == "observation" else (np.zeros(2), {**info, "measurement": z})

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.step_number = 0
        return self._seen()

    def step(self, action):
        self.step_number += 1
        return *self._seen()[:1], 0.0, False, False, self._seen()[1]


def plane():
    return line_model(c=np.eye(2), measurement_offset=[0.0, 0.0], measurement_noise_cov=[0.5, 0.5])


@pytest.mark.parametrize("place", ["observation", "measurement"])
def test_wrappers_and_problems_of_envs_take_them_as_missing(place):
    data = {}
    for way in ("masked", "nan"):
        env = EstimateState(Sensor(way, place), filter=make_filter("ekf", plane()))
        seen = [env.reset(seed=1)[0]] + [env.step([0.2])[0] for _ in range(8)]
        problem = EnvProblem(
            Sensor,
            lambda _: [0.2],
            plane(),
            steps=8,
            first_scored_step=2,
            env_arguments={"way": way, "place": place},
        )
        data[way] = seen, problem.data([1, 2]).measurements
    np.testing.assert_array_equal(data["masked"][0], data["nan"][0])
    np.testing.assert_array_equal(data["masked"][1], data["nan"][1])
    assert np.isnan(data["nan"][1]).sum() == 6 and type(data["masked"][1]) is np.ndarray


def test_a_vector_env_may_have_them():
    found = []
    for way in ("masked", "nan"):
        envs = gym.vector.SyncVectorEnv([lambda: Sensor("nan")] * 2, autoreset_mode="SameStep")
        wrapper = EstimateStates(envs, filter=make_filter("ekf", plane()))
        z = np.array([[0.5, 1.0], [2.0, 3.0]])
        where = np.array([[True, False], [False, False]])
        given = masked(z, where) if way == "masked" else np.where(where, np.nan, z)
        found.append(wrapper._measurements(given, {}))
    np.testing.assert_array_equal(*found)


def test_logs_and_tables_take_them_as_missing(tmp_path):
    columns = {"t": 0.1 * np.arange(6), "V_s": np.arange(6.0), "tach": np.arange(6.0)}
    where = np.array([False, False, True, False, True, False])
    hidden = {**columns, "tach": masked(columns["tach"], where)}
    plain = {**columns, "tach": np.where(where, np.nan, columns["tach"])}
    frame = pd.DataFrame({**columns, "tach": pd.array(np.where(where, pd.NA, columns["tach"]), dtype="Float64")})
    logs = [read_log(one, MODEL) for one in (hidden, plain, frame)]
    for log in logs:
        np.testing.assert_array_equal(log.measurements[:, 0], plain["tach"])
    given = masked(columns["tach"], where)[:, None]
    log = Log("run", 0.1, np.zeros((5, 1)), given, MODEL.input_quantities, MODEL.measurements)
    np.testing.assert_array_equal(log.measurements[:, 0], plain["tach"])
    env = EstimateState(ReplayEnv(log, MODEL), filter="kf")
    assert np.isfinite(env.reset(seed=0)[0]).all()


def test_where_nothing_may_be_missing_they_are_refused_in_one_line():
    model = line_model()
    inputs, measurements = simulated(model, 6)
    hidden = masked(inputs, np.ones(inputs.shape, dtype=bool))
    with pytest.raises(ValueError, match="must be finite numbers"):
        ModelProblem(model, inputs=hidden[0])
    data = Data((0,), inputs, masked(measurements, measurements > 1e9), filter_keys([0]), 0)
    with pytest.raises(
        ValueError, match="measurements of problem here must be a plain array, NaN where .* masked"
    ):
        check_data(data, model, "here")
    assert np.isnan(simulate(model, filter_keys([0]), hidden).states[0, -1]).all()
