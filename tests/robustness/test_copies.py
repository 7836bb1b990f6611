"""Everything that a user holds can be copied and pickled, and the copy goes on with the same numbers."""

import copy
import pickle
import subprocess
import sys

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the envs
from filters import FILTERS, EstimateState, EstimateStates, StateSpaceModel, make_filter, thruster_model
from filters.augmented import Unknown, augmented_model
from filters.engine.session import Session
from tests.models import pendulum, scalar_model, small, wide_model
from tests.thruster_env.thruster.test_robustness import AMPLIFIER, FLOW, REFERENCE, SENSORS, UNCERTAINTY
from tuning.evaluation.evaluate import evaluate
from tuning.plants.thruster import SCENARIOS
from tuning.search.plan import Plan
from tuning.search.space import untuned_choice

pytestmark = pytest.mark.usefixtures("as_python")

WAYS = {
    "deepcopy": copy.deepcopy,
    "pickle": lambda value: pickle.loads(pickle.dumps(value)),
    "cloudpickle": lambda value: pickle.loads(cloudpickle.dumps(value)),
}
DISTURBED = {"sensors": {"thrust": SENSORS}, "flow": FLOW, "amplifier": AMPLIFIER}
DISTURBED |= {"reference": REFERENCE, "uncertainty": UNCERTAINTY}
TRACKING = "BowThrusterTracking-v0"
SINGLE = {
    "plain": lambda: gym.make("BowThruster-v0"),
    "linear": lambda: gym.make("BowThrusterLinear-v0"),
    "disturbed": lambda: gym.make(TRACKING, **DISTURBED),
    "pictures": lambda: gym.make("BowThruster-v0", render_mode="rgb_array"),
    "wrapped": lambda: EstimateState(gym.make(TRACKING, **DISTURBED), "enkf", "belief", ensemble_size=5),
    "by id": lambda: gym.make("filters:BowThruster-EKF-v0", render_mode="rgb_array"),
}
VECTOR = {
    "native": lambda mode: gym.make_vec(TRACKING, 3, autoreset_mode=mode, **DISTURBED),
    "estimates": lambda mode: EstimateStates(
        gym.make_vec("BowThruster-v0", 3, autoreset_mode=mode), "pf", ensemble_size=9
    ),
}


def numbers_of(result):
    """All that a reset or a step returned, as arrays in a fixed order."""
    parts = []
    for value in result:
        parts += [value[key] for key in sorted(value)] if isinstance(value, dict) else [value]
    return parts


def assert_alike(one, other):
    for a, b in zip(numbers_of(one), numbers_of(other), strict=True):
        if isinstance(a, dict):
            assert_alike([a], [b])
        elif isinstance(a, np.ndarray) and a.dtype == object:
            for x, y in zip(a, b, strict=True):
                np.testing.assert_array_equal(x, y)
        else:
            np.testing.assert_array_equal(a, b)


def go_on(env, voltages):
    """What some steps, and resets between them, return."""
    results = []
    for k, voltage in enumerate(voltages):
        results.append(env.step(voltage))
        if k == 2 and not isinstance(env, gym.vector.VectorEnv):
            results.append(env.reset())
        if env.render_mode == "rgb_array":
            results.append([env.render()])
    return results


def assert_goes_on(env, voltages, way):
    """A copy equals the env after it, and neither is moved by the other."""
    copies = [way(env), way(env)]
    expected = go_on(env, voltages)
    for other in copies:
        for one, another in zip(expected, go_on(other, voltages), strict=True):
            assert_alike(one, another)


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
@pytest.mark.parametrize("make", SINGLE.values(), ids=SINGLE)
def test_a_copied_env_goes_on_with_the_same_numbers(make, way):
    env = make()
    assert_alike(way(env).reset(seed=3), env.reset(seed=3))
    env.action_space.seed(1)
    for voltage in (20.0, -5.0):
        env.step(np.array([voltage], dtype=np.float32))
    assert way(env).action_space.sample() == env.action_space.sample()
    assert_goes_on(env, np.linspace(-24.0, 24.0, 5, dtype=np.float32)[:, None], way)


@pytest.mark.parametrize("mode", list(gym.vector.AutoresetMode)[:2])
@pytest.mark.parametrize("make", VECTOR.values(), ids=VECTOR)
@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_a_copied_vector_env_goes_on_with_the_same_numbers(make, way, mode):
    env = make(mode)
    env.reset(seed=3)
    base = env.unwrapped
    base._last_time = 4 * base.plant.dt  # so that episodes end
    env.step(np.full((3, 1), 10.0, dtype=np.float32))
    assert_goes_on(env, np.random.default_rng(0).uniform(-24, 24, (7, 3, 1)), way)


def test_a_shallow_copy_has_a_memory_of_its_own():
    for env in (SINGLE["plain"]().unwrapped, VECTOR["native"]("NextStep")):
        env.reset(seed=0)
        voltages = np.full((2, *env.action_space.shape), 5.0)
        assert_goes_on(env, voltages, copy.copy)


@pytest.mark.parametrize("name", FILTERS)
def test_a_copied_filter_and_its_session_go_on_with_the_same_numbers(name):
    kind = small(name, scalar_model() if name == "kf-steady" else thruster_model())
    session = Session(kind)
    session.start((1, 2), [0.5])
    session.step([3.0], [0.7])
    for way in WAYS.values():
        belief, other = kind.predict(kind.init((5, 6)), [1.0]), way(kind)
        for one, another in zip(belief, other.predict(way(kind.init((5, 6))), [1.0]), strict=True):
            np.testing.assert_array_equal(one, another)
        copies = [way(session), copy.copy(session)]
        session.step([1.0], [0.2])
        for another in copies:
            another.step([1.0], [0.2])
            assert another.mean.base is another._row and another.divergences == session.divergences
            np.testing.assert_array_equal(another.mean, session.mean)
            np.testing.assert_array_equal(another.cov, session.cov)


def wandering(x, u, c):
    return (x[0] + c[0] * x[0] ** 2 + u[0],)


def seen(x, c):
    return (x[0] ** 3,)


MODELS = {
    "thruster": thruster_model,
    "channels": lambda: thruster_model(sensors=["thrust", "speed-magnitude"]),
    "affine": wide_model,
    "pendulum": pendulum,
    "analytic": lambda: StateSpaceModel(
        transition=wandering,
        observe=seen,
        process_noise_cov=1.0,
        measurement_noise_cov=1.0,
        prior_mean=[0.3],
        prior_cov=1.0,
        constants=(0.1,),
        analytic=True,
    ),
    "augmented": lambda: augmented_model(MODELS["channels"](), {"load_gain": Unknown(0.1)}),
    "parameters of an analytic model": lambda: augmented_model(MODELS["analytic"](), {0: Unknown(0.1)}),
}


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)
def test_a_copied_model_is_the_same_model(make):
    model = make()
    for way in (*WAYS.values(), copy.copy):
        other = way(model)
        np.testing.assert_array_equal(other.numbers, model.numbers)
        for function in ("transition", "observe", "transition_jacobian", "observe_jacobian"):
            # The very same function: nothing is compiled again.
            assert getattr(other, function) is getattr(model, function)


def test_a_model_of_inner_functions_is_for_cloudpickle():
    gain = 0.5
    model = pendulum().replace(transition=lambda x, u, c: (gain * x[0], x[1]), transition_jacobian=None)
    assert pickle.loads(cloudpickle.dumps(model)).transition((2.0, 1.0), (0.0,), ()) == (1.0, 1.0)
    assert copy.deepcopy(model).transition is model.transition
    with pytest.raises((pickle.PicklingError, AttributeError), match="lambda"):
        pickle.dumps(model)


def test_what_studies_make_can_be_copied():
    scenario = SCENARIOS["outliers"]
    choice = untuned_choice("ekf", scenario)
    data = scenario.replace(steps=60).data([1, 2])
    plan = Plan("ekf", tuple(SCENARIOS.values()))
    values = {
        "scenario": scenario,
        "plan": plan,
        "choice": choice,
        "data": data,
        "evaluation": evaluate(make_filter("ekf", scenario.model(**scenario.untuned)), data, scenario.scale),
    }
    for way in (*WAYS.values(), copy.copy):
        for value in values.values():
            assert repr(way(value)) == repr(value)
        other = way(scenario)
        assert other == scenario and hash(other) == hash(scenario) and other.digest == scenario.digest
        with pytest.raises(TypeError):
            other.parameter_factors["area"] = 2.0


def test_a_pickle_loads_in_a_fresh_process():
    env = gym.make("filters:BowThruster-EKF-v0")
    env.reset(seed=1)
    source = (
        "import pickle, sys; from thruster_env.core.compiled import interpreted\n"
        "with interpreted():\n"
        "    env = pickle.load(sys.stdin.buffer); print(env.step([3.0])[0].tobytes().hex())"
    )
    done = subprocess.run([sys.executable, "-c", source], input=pickle.dumps(env), capture_output=True)
    assert done.stdout.decode().strip() == env.step([3.0])[0].tobytes().hex(), done.stderr.decode()
