"""Wrong types in Python: refused in one line that states the rule, before anything has moved."""

import math
from itertools import product

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the envs
from filters import EstimateState, EstimateStates, make_filter, run, smooth, thruster_model
from filters.engine.belief import LostBelief
from filters.engine.session import Session
from tests.models import DT, KEY, pendulum, scalar_model, small

pytestmark = pytest.mark.usefixtures("as_python")


def single():
    return gym.make("BowThruster-v0")


def vector(**arguments):
    return gym.make_vec("BowThruster-v0", 3, **arguments)


GENERATOR = np.random.default_rng(0)  # whose draws no model may have


def refused(call, rule):
    with pytest.raises(ValueError, match=rule) as error:
        call()
    assert "\n" not in str(error.value) and "must" in str(error.value)


ENVS = {
    "single": single,
    "vector": vector,
    "estimate": lambda: EstimateState(single()),
    "estimates": lambda: EstimateStates(vector()),
}


@pytest.mark.parametrize("make", ENVS.values(), ids=ENVS)
@pytest.mark.parametrize("seed", [1.5, "1", True, np.bool_(True), -1, [1.5] * 3, {"a": 1}, np.float64(3.0), 1j])
def test_a_seed_is_a_whole_number(make, seed):
    rule = "a seed must be None or a whole number of at least 0, but got"
    refused(lambda: make().unwrapped.reset(seed=seed), rule)
    if not isinstance(make(), gym.Env):  # Gymnasium's own wrappers hold the others back
        refused(lambda: make().reset(seed=seed), rule)


@pytest.mark.parametrize("make", ENVS.values(), ids=ENVS)
def test_a_seed_may_be_a_number_of_numpy(make):
    for kind in (np.int64, np.uint8):
        expected = make().reset(seed=7)
        for one, other in zip(make().reset(seed=kind(7)), expected, strict=True):
            np.testing.assert_equal(one, other)


@pytest.mark.parametrize("make", ENVS.values(), ids=ENVS)
@pytest.mark.parametrize("options", [5, [1], "state"])
def test_options_are_a_mapping(make, options):
    refused(lambda: make().unwrapped.reset(options=options), "options must be None or a mapping, but got")


@pytest.mark.parametrize("make", [vector, ENVS["estimates"]])
def test_the_first_reset_is_of_all_copies(make):
    env = make(autoreset_mode="Disabled") if make is vector else make()
    some = {"reset_mask": np.array([True, False, True])}
    refused(lambda: env.reset(options=some), "reset_mask must have all copies at the first reset, but got")
    for mask in ([[True]] * 3, "all", 1, [1, 0, 1]):
        refused(lambda: env.reset(options={"reset_mask": mask}), "reset_mask must be 3 booleans")  # noqa: B023
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros((3, 1)))
    env.reset(seed=1, options={"reset_mask": np.ones(3, dtype=bool)})
    env.reset(options=some)
    env.step(np.zeros((3, 1)))


ACTIONS = ["full", "12", b"1", [1j], 1j, None, {}, [], [1.0, 2.0], math.nan, np.array(["1"]), [[1.0], [2.0, 3.0]]]


@pytest.mark.parametrize("action", ACTIONS, ids=str)
def test_an_action_that_is_none_leaves_the_env_where_it_was(action):
    for env, whose in ((single().unwrapped, "an action"), (EstimateState(single()), "an action")):
        env.reset(seed=1)
        refused(lambda: env.step(action), f"{whose} must be one voltage|{whose} must be 1 number")  # noqa: B023
        assert env.step(np.array([1.0]))[-1]["time"] == pytest.approx(0.01)
    for envs in (vector(), EstimateStates(vector())):
        envs.reset(seed=1)
        refused(lambda: envs.step([action] * 3), "actions must be")  # noqa: B023
        np.testing.assert_allclose(envs.step(np.zeros((3, 1)))[-1]["time"], 0.01)


def test_a_foreign_env_is_not_stepped_either():
    class Counting(gym.Env):
        action_space = gym.spaces.Box(-1.0, 1.0, (2,))
        observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
        steps = 0

        def reset(self, *, seed=None, options=None):
            return np.zeros(1), {}

        def step(self, action):
            self.steps += 1
            return np.zeros(1), 0.0, False, False, {}

    env = EstimateState(Counting(), model=scalar_model(b=[[1.0, 2.0]]))
    env.reset(seed=0)
    for action in ("no", [1.0], [1.0, math.nan], [1j, 1j]):
        refused(lambda: env.step(action), "an action must be 2 numbers")  # noqa: B023
    assert env.unwrapped.steps == 0
    env.step([0.5, 3])
    assert env.unwrapped.steps == 1


NO_NUMBERS = ["one", None, [1j], 1j, [None], {}, [[1.0], [2.0, 3.0]], [1.0, 2.0], ["1"]]


@pytest.mark.parametrize("wrong", NO_NUMBERS, ids=str)
def test_a_filter_takes_numbers(wrong):
    ekf = make_filter("ekf", scalar_model())
    belief = ekf.init(KEY)
    refused(lambda: ekf.predict(belief, wrong), "u must be 1 number, each finite, but got")
    if wrong == [None]:  # a missing sample
        np.testing.assert_array_equal(ekf.update(belief, wrong)[0].mean, ekf.update(belief, [math.nan])[0].mean)
    else:
        refused(lambda: ekf.update(belief, wrong), "z must be 1 number, each finite or NaN, but got")
    refused(lambda: ekf.init(wrong if wrong != [1.0, 2.0] else [1.5, 2.0]), "key must be two whole numbers")
    refused(lambda: ekf.init([-1, 2**32]), "key must be two whole numbers")
    good = {"keys": np.ones((1, 2)), "inputs": np.ones((1, 3, 1)), "measurements": np.ones((1, 4, 1))}
    for name in good:
        if wrong is not None or name == "measurements":  # no keys are those by number; inputs, none
            for use in (run, smooth):
                refused(lambda: use(ekf, **{**good, name: wrong}), "must")  # noqa: B023
    if wrong not in ([1.0, 2.0], [None], ["1"]):  # NumPy takes these for numbers; a step has to be quick
        session = Session(ekf)
        session.start(KEY, [1.0])
        refused(lambda: session.step(wrong, [1.0]), "u must be 1 number")
        refused(lambda: session.step([1.0], wrong), "z must be 1 number")


@pytest.mark.parametrize("name", ["ekf", "enkf", "pf", "vb"])
@pytest.mark.parametrize(
    ("part", "value", "rule"),
    [
        ("mean", [math.nan, 0.0], "mean of a belief must be finite, but got .*nan"),
        ("mean", [math.inf, 0.0], "mean of a belief must be finite, but got .*inf"),
        ("cov", [[1.0, math.nan], [math.nan, 1.0]], "cov of a belief must be 2 variances .* finite"),
        ("cov", [[1.0, 0.0], [0.0, -1.0]], r"cov of a belief must be positive semidefinite .*, but got"),
        ("cov", [[1.0, 2.0], [2.0, 1.0]], "cov of a belief must be positive semidefinite"),
        ("cov", [[1.0, 0.5], [0.0, 1.0]], "cov of a belief must be .* symmetric"),
        ("members", math.nan, "members of a belief must be finite, but got"),
        ("extras", math.nan, "extras of a belief must not be NaN, but got"),
        ("step", -1, "step of a belief must be a whole number"),
        ("key", (1.5, 2), "key must be two whole numbers"),
    ],
)
def test_a_belief_that_is_none_is_refused(name, part, value, rule):
    kind = small(name, thruster_model())
    belief = kind.init(KEY)
    if part in ("members", "extras"):
        value = np.full_like(getattr(belief, part), value)
        if not value.size:
            return
    belief = belief._replace(**{part: np.array(value) if isinstance(value, list) else value})
    refused(lambda: kind.predict(belief, [1.0]), rule)
    refused(lambda: kind.update(belief, [1.0]), rule)


def test_a_belief_that_a_prediction_lost_says_so_and_restarts():
    ekf = make_filter("ekf", scalar_model(a=[[1e200]], c=[[1.0]]))
    lost = ekf.predict(ekf.predict(ekf.init(KEY), [1.0]), [1.0])
    assert isinstance(lost, LostBelief) and not np.isfinite(lost.mean).all()
    belief, _ = ekf.update(lost, [1.0])
    assert not isinstance(belief, LostBelief) and belief.divergences == 1 and belief.mean == [3.0]


def test_every_path_counts_a_negative_variance_alike_as_a_failure():
    """Joseph's form leaves one, by rounding, where variances lie many orders of magnitude apart."""
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(40, 2, 2)) * 10.0 ** rng.uniform(-8, 8, (40, 2, 1))
    model = thruster_model(process_noise_cov=[1e-8, 1e-8], measurement_noise_cov=1e-8)
    z, u, counts = np.full((1, 3, 1), 5.0), np.full((1, 2, 1), 12.0), []
    for factor in roots:
        filter_ = make_filter("ekf", model.replace(prior_cov=factor @ factor.T))
        session = Session(filter_)
        session.start(KEY, z[0, 0])
        belief, _ = filter_.update(filter_.init(KEY), z[0, 0])
        for k in range(2):
            session.step(u[0, k], z[0, k + 1])
            belief, _ = filter_.update(filter_.predict(belief, u[0, k]), z[0, k + 1])
        estimates = run(filter_, np.array([KEY]), u, z)
        assert (np.einsum("bkii->bki", estimates.covs) >= 0).all() and (np.diag(belief.cov) >= 0).all()
        assert estimates.divergences == session.divergences == belief.divergences
        counts.append(session.divergences)
    assert 0 < sum(counts) < 80


@pytest.mark.parametrize("value", [[1.0, -1e-14], [[1.0, 2.0], [2.0, 1.0]], ["1", "2"], [1j, 1.0]])
def test_a_covariance_that_is_none_is_refused(value):
    kind = make_filter("ekf", thruster_model())
    refused(lambda: kind.predict(kind.init(KEY), [1.0], process_noise_cov=value), "process_noise_cov must be")
    refused(lambda: thruster_model(process_noise_cov=value), "process_noise_cov must be")
    refused(lambda: kind.model.replace(prior_cov=value), "prior_cov must be")
    refused(lambda: single().unwrapped.__class__(process_noise_cov=value), "process_noise_cov must be")


def one_entry(x, u, c):
    return (x[0],)


def no_constants(x, u):
    return x


def reads_too_much(x, u, c):
    return (x[0] + u[1], x[1])


def fails(x, c):
    raise KeyError("speed")


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        (
            {"measurement_noise_cov": [0.1]},
            "observe must return a tuple of 1 measurement, as measurement_noise_cov is 1 x 1, but returned 2",
        ),
        (
            {"transition": one_entry},
            "transition must return a tuple of 2 states, as prior_mean has 2, but returned 1 entry",
        ),
        ({"observe": lambda x, c: x[0]}, "observe must return a tuple of 2 .*, but returned the number 0.5"),
        ({"observe": lambda x, c: (x, x)}, "observe must return .*, but returned 2 x 2 numbers"),
        ({"observe": lambda x, c: "12"}, "observe must return .*, but returned '12'"),
        ({"observe": lambda x, c: None}, "observe must return .*, but returned None"),
        ({"observe": lambda x, c: (1j, 0.0)}, "observe must return .*, but returned "),
        ({"transition": no_constants}, r"transition must be a function of \(x, u, c\), but takes \(x, u\)"),
        ({"observe": 3.0}, r"observe must be a function of \(x, c\), but got 3.0"),
        (
            {"transition": reads_too_much},
            "transition.* must work for 2 states and 1 input, but raised IndexError: tuple",
        ),
        (
            {"observe": fails},
            r"observe \(function fails, test_wrong_arguments.py line \d+\) must work for .* KeyError",
        ),
        (
            {"constants": {"g": 9.81, "d": 0.3}},
            "constants must be a NamedTuple or a tuple of finite numbers, but got",
        ),
        ({"constants": ("9.81", 0.3)}, "constants must be a NamedTuple or a tuple of finite numbers"),
        ({"constants": (9.81,)}, "transition.* must work for .* but raised IndexError"),
        (
            {"transition_jacobian": lambda x, u, c: ((1.0, DT),)},
            "transition_jacobian must return 2 rows of 2, as prior_mean has 2, but returned 1 x 2 numbers",
        ),
        ({"observe_jacobian": lambda x, c: (1.0, 0.0)}, "observe_jacobian must return 2 rows of 2, .* 2 entries"),
        (
            {"observe": lambda x, c: (x[0], math.sqrt(-x[0]))},
            "observe must not be NaN at the prior mean with inputs of zero, but got .*",
        ),
        (
            {"transition": lambda x, u, c: (x[0], np.log(u[0] - 1.0))},
            r"transition must not be NaN at the prior mean with inputs of zero, but got \(0.5, .*nan",
        ),
        (
            {"observe": lambda x, c: (x[0] + GENERATOR.normal(), x[1])},
            "observe .* must depend on its arguments alone, .* belongs in measurement_noise_cov",
        ),
    ],
)
def test_a_model_is_tried_when_it_is_made(changes, rule):
    refused(lambda: pendulum(**changes), rule)


def test_what_has_no_value_at_the_mean_is_tried_beside_it():
    changes = {"prior_mean": [0.0, 0.0]}
    pendulum(observe=lambda x, c: (1.0 / x[0], math.log(x[1])), **changes)
    refused(lambda: pendulum(observe=lambda x, c: (1.0 / x[0],), **changes), "but returned 1 entry")
    # Each extended step would restart: a limit is due, or no Jacobian, where differences take its place.
    refused(lambda: pendulum(observe_jacobian=lambda x, c: ((math.nan, 0.0), (0.0, 1.0))), "must be finite at the")


def test_whatever_keys_inputs_and_measurements_are_they_are_taken_or_refused_in_one_line():
    filter_ = make_filter("ekf", thruster_model())
    arrays = [np.ones(shape) for shape in ((), (3,), (3, 1), (2, 3, 1), (1, 2, 3, 1))]
    anything = [True, 1.0, "a", None, [], [1, 2], {}, object(), math.nan, np.array("x"), 1j, *arrays]
    for keys, inputs, measurements in product([None, True, [[1, 2]]], anything, anything):
        try:
            run(filter_, keys, inputs, measurements)
        except ValueError as error:
            assert "\n" not in str(error)
