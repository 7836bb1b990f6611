"""Models of one's own: their checks, truths drawn from them, copies, and what numba makes of them or not."""

import contextlib
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from filters import ExtendedKalmanFilter, StateSpaceModel, affine_model, make_filter, run, thruster_model
from tests.filters.checks import refused
from tests.models import affine, state_space
from tests.oracles import each_close, each_equal
from thruster_env.core.compiled import interpreted
from thruster_env.core.sources import as_value
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate
from thruster_env.model.quantities import Quantity
from thruster_env.thruster.equations import simulate as simulate_plant
from thruster_env.thruster.plant import make_plant


class Spring(NamedTuple):
    stiffness: float
    damping: float


def spring_step(x, u, c):
    return (x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - c[0] * x[0] - c[1] * x[1]))


def spring_step_by_name(x, u, c):
    return (x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - c.stiffness * x[0] - c.damping * x[1]))


def position(x, c):
    return (x[0],)


def spring(**changes):
    noise = {"q": [[0.01, 0.004], [0.004, 0.02]], "r": 0.1}
    prior = {"mean": [1.0, 0.0], "cov": [0.5, 0.5]}
    return state_space(spring_step, position, **noise, **prior, **{"constants": (2.0, 0.3), **changes})


class TestChecks:
    def test_shapes_are_made_whole(self):
        model = spring()
        assert (model.n, model.m, model.inputs, model.substeps) == (2, 1, 1, 1)
        each_equal((model.prior_cov, model.measurement_noise_cov), ([[0.5, 0.0], [0.0, 0.5]], [[0.1]]))

    def test_what_is_handed_in_is_copied(self):
        q = np.array([[0.01, 0.0], [0.0, 0.02]])
        model = spring(process_noise_cov=q)
        q[:] = 7.0
        np.testing.assert_array_equal(model.process_noise_cov, [[0.01, 0.0], [0.0, 0.02]])

    @pytest.mark.parametrize(
        ("change", "rule"),
        [
            ({"prior_mean": [np.nan, 0.0]}, "prior_mean must be .*finite numbers, but got .*nan"),
            ({"prior_mean": [[1.0, 0.0]]}, "prior_mean must be .*finite numbers"),
            ({"prior_mean": "rest"}, "prior_mean must be .*but got 'rest'"),
            ({"prior_mean": {}}, "prior_mean must be .*but got {}"),
            ({"prior_cov": [1.0, -1.0]}, r"prior_cov must be positive semidefinite.*but got \[1.0, -1.0\]"),
            ({"prior_cov": [[1.0, 2.0], [2.0, 1.0]]}, "prior_cov must be positive semidefinite"),
            ({"prior_cov": [[1.0, 0.5], [0.0, 1.0]]}, "prior_cov must be 2 variances or a symmetric 2 x 2"),
            ({"prior_cov": [1.0, 1.0, 1.0]}, "prior_cov must be 2 variances"),
            ({"process_noise_cov": [-0.1, 1.0]}, "process_noise_cov must be positive semidefinite.*-0.1"),
            ({"process_noise_cov": "small"}, "process_noise_cov must be 2 variances.*but got 'small'"),
            ({"measurement_noise_cov": 0.0}, "measurement_noise_cov must be positive definite, but got .*0"),
            ({"measurement_noise_cov": -1.0}, "measurement_noise_cov must be positive semidefinite.*-1"),
            ({"measurement_noise_cov": [[1.0, 1.0], [1.0, 1.0]]}, "measurement_noise_cov must be positive def"),
            ({"measurement_noise_cov": None}, "measurement_noise_cov must be"),
            ({"measurement_noise_cov": "small"}, "measurement_noise_cov must be .*but got 'small'"),
            ({"substeps": 0}, "substeps must be a whole number of at least 1, but got 0"),
            ({"substeps": 1.5}, "substeps must be a whole number of at least 1, but got 1.5"),
            ({"inputs": -1}, "inputs must be a whole number of at least 0, but got -1"),
            ({"operating_state": [1.0]}, r"operating_state must be 2 finite numbers, but got \[1.0\]"),
            ({"operating_input": [1.0, 2.0]}, "operating_input must be 1 finite number, but got"),
        ],
    )
    def test_a_wrong_argument_is_refused_with_rule_and_value(self, change, rule):
        refused(rule, spring, **change)

    @pytest.mark.parametrize(
        ("change", "rule"),
        [
            ({"a": [[1.0, 0.0]]}, "a, b, c must have shapes"),
            ({"b": [[1.0]]}, "a, b, c must have shapes"),
            ({"c": [[1.0]]}, "a, b, c must have shapes"),
            ({"state_offset": [1.0, 2.0, 3.0]}, "state_offset must be 2 finite numbers"),
            ({"state_offset": [1.0]}, "state_offset must be 2 finite numbers"),
            ({"measurement_offset": [1.0, 2.0]}, "measurement_offset must be 1 finite number"),
            (
                {"prior_mean": [0.0] * 3, "prior_cov": [1.0] * 3, "process_noise_cov": [1.0] * 3},
                "prior_mean must be 2 finite numbers",
            ),
            ({"measurement_noise_cov": [1.0, 1.0]}, "measurement_noise_cov must be 1 variances"),
        ],
    )
    def test_an_affine_model_whose_shapes_do_not_fit_is_refused(self, change, rule):
        arguments = {
            "a": np.eye(2),
            "b": np.ones((2, 1)),
            "c": np.ones((1, 2)),
            "process_noise_cov": [1.0, 1.0],
            "measurement_noise_cov": [1.0],
            "prior_mean": [0.0, 0.0],
            "prior_cov": [1.0, 1.0],
        }
        affine_model(**arguments)
        refused(rule, affine_model, **{**arguments, **change})


def test_replace_changes_what_it_is_told_and_checks_it():
    model = spring()
    other = model.replace(process_noise_cov=[1.0, 2.0])
    np.testing.assert_array_equal(other.process_noise_cov, np.diag([1.0, 2.0]))
    assert other.transition is model.transition
    refused("process_noise_cov", model.replace, process_noise_cov=[-1.0, 2.0])


def test_an_affine_model_does_what_its_matrices_say():
    rng = np.random.default_rng(0)
    a, b, c, offset, shift = (rng.normal(size=s) for s in ((3, 3), (3, 2), (2, 3), 3, 2))
    prior = {"mean": [0.0] * 3, "cov": [1.0] * 3}
    model = affine(a, b, c, q=[1.0] * 3, r=[1.0] * 2, **prior, state_offset=offset, measurement_offset=shift)
    x, u = rng.normal(size=3), rng.normal(size=2)
    np.testing.assert_allclose(model.transition(x, u, model.constants), a @ x + b @ u + offset, rtol=1e-14)
    np.testing.assert_allclose(model.observe(x, model.constants), c @ x + shift, rtol=1e-14)
    np.testing.assert_array_equal(model.transition_jacobian(x, u, model.constants), a)
    np.testing.assert_array_equal(model.observe_jacobian(x, model.constants), c)
    each_equal(model.matrices(), (a, b, offset, c, shift))


class TestTruth:
    @pytest.mark.parametrize("initial_state", [None, {"voltage": 6.0}])
    def test_the_model_of_the_thruster_draws_the_plant_s_own_truth(self, initial_state):
        arguments = {"initial_state": initial_state, "process_noise_cov": [[1.0, 0.008], [0.008, 4e-4]]}
        keys = episode_keys(range(5))
        inputs = np.random.default_rng(0).uniform(-24, 24, size=(5, 200, 1))
        of_model = simulate.simulate(thruster_model(**arguments), keys, inputs)
        of_plant = simulate_plant(make_plant(**arguments), keys, inputs[..., 0])
        close = {"rtol": 1e-12, "atol": 1e-12}
        each_close((of_model.states, of_model.measurements), (of_plant.states, of_plant.measurements), **close)

    def test_its_noise_has_the_covariances_of_the_model(self):
        model = spring(measurement_noise_cov=[[0.5, -0.3], [-0.3, 0.4]], observe=both_parts)
        inputs = np.ones((1, 2000, 1))
        with interpreted():
            states, measurements = simulate.simulate(model, episode_keys([0]), inputs)
        after = np.array([spring_step(x, (1.0,), model.constants) for x in states[0, :-1]])
        w, v = states[0, 1:] - after, measurements[0] - states[0]
        for sample, cov in ((w, model.process_noise_cov), (v, model.measurement_noise_cov)):
            spread = np.sqrt(np.diag(cov))
            assert (np.abs(sample.mean(axis=0)) < 4 * spread / np.sqrt(2000)).all()
            standard_error = np.sqrt((np.outer(spread**2, spread**2) + cov**2) / 2000)
            assert (np.abs(np.cov(sample.T) - cov) < 4 * standard_error).all()

    def test_the_initial_state_has_the_prior_s_covariance(self):
        model = spring(prior_mean=[3.0, -2.0], prior_cov=[[0.5, 0.3], [0.3, 0.4]])
        with interpreted():
            states, _ = simulate.simulate(model, episode_keys(range(1000)), np.zeros((1000, 0, 1)))
        error = np.abs(states[:, 0].mean(axis=0) - model.prior_mean)
        assert (error < 4 * np.sqrt(np.diag(model.prior_cov) / 1000)).all()
        assert np.abs(np.cov(states[:, 0].T) - model.prior_cov).max() < 4 * 0.5 * np.sqrt(2 / 1000)

    @pytest.mark.parametrize(
        ("keys", "inputs"), [((3, 2), (2, 5, 1)), ((2, 1), (2, 5, 1)), ((2, 2), (2, 5, 2)), ((2, 2), (2, 5))]
    )
    def test_shapes_that_do_not_fit_are_refused(self, keys, inputs):
        with interpreted(), pytest.raises(ValueError, match="shapes"):
            simulate.simulate(spring(), np.zeros(keys), np.zeros(inputs))


def both_parts(x, c):
    return (x[0], x[1])


def test_constants_may_be_a_named_tuple():
    by_name = spring(transition=spring_step_by_name, constants=Spring(2.0, 0.3))
    inputs, z = np.ones((1, 20, 1)), np.random.default_rng(0).normal(size=(1, 21, 1))
    with interpreted():
        one = run(ExtendedKalmanFilter(model=spring()), np.zeros((1, 2)), inputs, z)
        other = run(ExtendedKalmanFilter(model=by_name), np.zeros((1, 2)), inputs, z)
    np.testing.assert_array_equal(one.means, other.means)


NUMBERS = {"stiffness": 2.0, "damping": 0.3}  # a dictionary outside the function: numba cannot read it
TURNS = [0.1]  # a list


def spring_step_by_dictionary(x, u, c):
    return (x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - NUMBERS["stiffness"] * x[0] - NUMBERS["damping"] * x[1]))


def spring_step_with_text(x, u, c):
    text = f"{x[0]:.3f}"  # noqa: F841 - numba refuses formats before it looks at types
    return spring_step(x, u, c)


def spring_step_with_catch(x, u, c):
    try:
        return spring_step(x, u, c)
    except ZeroDivisionError:
        return x


def spring_step_with_loop(x, u, c):
    left = {"left": x[0] - x[0] + TURNS[0]}  # numba knows no list outside, and the graph no end of the loop
    while left["left"] > 0.0:
        left["left"] -= abs(x[0]) + 1.0
    return spring_step(x, u, c)


class SpringStep:
    """A model whose step is not a function at all."""

    def __call__(self, x, u, c):
        return spring_step(x, u, c)


@pytest.mark.parametrize(
    "transition",
    [spring_step_by_dictionary, spring_step_with_text, SpringStep()],
    ids=["dictionary", "text", "object"],
)
@pytest.mark.filterwarnings("error:the model runs as Python")
class TestModelsThatNumbaRefuses:
    @pytest.mark.parametrize(("name", "numbers"), [("ekf", {}), ("pf", {"ensemble_size": 5})])
    def test_a_filter_of_a_page_has_the_results_of_a_compilable_twin(self, transition, name, numbers):
        keys, inputs = episode_keys(range(3)), np.ones((3, 10, 1))
        z = np.random.default_rng(0).normal(size=(3, 11, 1))
        with interpreted():
            expected = run(make_filter(name, spring(), **numbers), keys, inputs, z)
        found = run(make_filter(name, spring(transition=transition), **numbers), keys, inputs, z)
        for part, rescaled in zip(found, expected, strict=True):  # one of them has central differences for F
            np.testing.assert_allclose(part, rescaled, rtol=1e-8, atol=1e-8)

    def test_others_and_truths_are_machine_code_of_its_graph(self, transition):
        keys, inputs = episode_keys(range(3)), np.ones((3, 10, 1))
        z = np.random.default_rng(0).normal(size=(3, 11, 1))
        with interpreted():
            expected = run(make_filter("open-loop", spring()), keys, inputs, z)
            truth = simulate.simulate(spring(), keys, inputs)
        found = run(make_filter("open-loop", spring(transition=transition)), keys, inputs, z)
        each_close(found, expected, rtol=1e-12, atol=1e-12)
        drawn = simulate.simulate(spring(transition=transition), keys, inputs)
        np.testing.assert_allclose(drawn.states, truth.states, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("transition", [spring_step_with_catch, spring_step_with_loop], ids=["catch", "loop"])
class TestModelsThatRunAsPython:
    def test_others_run_with_one_warning_and_the_results_of_a_compilable_twin(self, transition):
        name = "open-loop"  # others have pages
        keys, inputs = episode_keys(range(3)), np.ones((3, 10, 1))
        z = np.random.default_rng(0).normal(size=(3, 11, 1))
        with interpreted():
            expected = run(make_filter(name, spring()), keys, inputs, z)
        filter_ = make_filter(name, spring(transition=transition))
        with pytest.warns(UserWarning, match="the model runs as Python") as warned:
            found = run(filter_, keys, inputs, z)
            again = run(filter_, keys, inputs, z)
        assert len([w for w in warned if "runs as Python" in str(w.message)]) == 1
        for part, repeated, rescaled in zip(found, again, expected, strict=True):
            np.testing.assert_allclose(part, rescaled, rtol=1e-12, atol=1e-12)
            np.testing.assert_array_equal(part, repeated)

    def test_their_truths_are_drawn_all_the_same(self, transition):
        keys, inputs = episode_keys(range(2)), np.ones((2, 5, 1))
        with interpreted():
            expected = simulate.simulate(spring(), keys, inputs)
        with pytest.warns(UserWarning, match="runs as Python"):
            found = simulate.simulate(spring(transition=transition), keys, inputs)
        np.testing.assert_allclose(found.states, expected.states, rtol=1e-12, atol=1e-12)


OWN_MODEL = """
import numpy as np
from filters import ExtendedKalmanFilter, StateSpaceModel, run

def transition(x, u, c):
    return (FACTOR * x[0],)

def observe(x, c):
    return (x[0],)

def means():
    model = StateSpaceModel(
        transition=transition, observe=observe, process_noise_cov=[0.1], measurement_noise_cov=[0.1],
        prior_mean=[1.0], prior_cov=[1.0],
    )
    nothing = np.full((1, 2, 1), np.nan)
    return run(ExtendedKalmanFilter(model=model), np.zeros((1, 2)), np.zeros((1, 1, 0)), nothing).means
"""


@pytest.mark.slow
def test_a_model_that_was_edited_is_never_served_from_the_old_cache(tmp_path):
    """Machine code is kept by its instructions; the models of two folders may bear one name."""
    root = Path(__file__).parents[2]
    for factor in ("0.5", "0.25"):
        (tmp_path / "own_model.py").write_text(OWN_MODEL.replace("FACTOR", factor))
        found = subprocess.run(
            [sys.executable, "-W", "error", "-c", "import own_model; print(own_model.means()[0, 1, 0])"],
            cwd=root,
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(root)])},
            capture_output=True,
            text=True,
            check=True,
        )
        assert float(found.stdout) == float(factor)


def swing(x, u, c):
    return (x[0] + 0.05 * x[1], x[1] + 0.05 * (15.0 * np.sin(x[0]) + 3.0 * u[0]))


def swing_jacobian(x, u, c):
    return ((1.0, 0.05), (0.75 * np.cos(x[0]), 1.0))


def seen(x, c):
    return (np.cos(x[0]), np.exp(0.1 * x[0] * x[1]), 2.0)


def swinging(**changes):
    prior = {"mean": [0.3, -0.2], "cov": [0.1, 0.1]}
    return state_space(swing, seen, q=[1e-4, 1e-2], r=[0.01, 0.01, 1.0], **prior, **changes)


@pytest.mark.parametrize("plainly", [pytest.param(False, marks=pytest.mark.slow), True])
def test_complex_steps_give_an_analytic_model_exact_jacobians(plainly):
    keys, inputs = episode_keys(range(3)), np.random.default_rng(0).normal(size=(3, 30, 1))
    measurements = simulate.simulate(swinging(), keys, inputs).measurements
    exact, declared = swinging(transition_jacobian=swing_jacobian), swinging(analytic=True)
    x, u = (0.7, -1.3), (0.4,)
    assert declared.transition_jacobian(x, u, ()) == pytest.approx(np.array(swing_jacobian(x, u, ())), rel=1e-15)
    slope = np.exp(-0.091) * 0.1
    expected = np.array([[-np.sin(0.7), 0.0], [-1.3 * slope, 0.7 * slope], [0.0, 0.0]])
    assert np.array(declared.observe_jacobian(x, ())) == pytest.approx(expected, rel=1e-15)
    with interpreted() if plainly else contextlib.nullcontext():
        found, wanted = (
            run(ExtendedKalmanFilter(model=model), keys, inputs, measurements)
            for model in (declared, exact.replace(observe_jacobian=declared.observe_jacobian))
        )
    np.testing.assert_allclose(found.means, wanted.means, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("size", [2, 40])
def test_a_root_at_zero_has_no_steep_slope_by_a_complex_step(size):
    def emptied(x, u, c):
        outflow = [0.1 * np.sqrt(one) for one in np.linalg.solve(np.eye(size), np.array([*x]))]
        return np.array([one - flow for one, flow in zip(x, outflow, strict=True)])

    prior = {"mean": [0.0, 4.0] * (size // 2), "cov": [0.1] * size}
    model = state_space(emptied, lambda x, c: (x[0],), q=[0.01] * size, r=[0.1], **prior, inputs=0, analytic=True)
    slopes = np.array(model.transition_jacobian(as_value(model.prior_mean), (), ()))
    np.testing.assert_allclose(slopes, np.diag([0.0, 0.975] * (size // 2)), atol=1e-15)


def test_a_jacobian_by_complex_steps_follows_its_function_and_a_given_one_stays():
    model = swinging(analytic=True, transition_jacobian=swing_jacobian)
    assert model.transition_jacobian is swing_jacobian
    changed = model.replace(observe=lambda x, c: (x[0] ** 2, x[1], 0.0))
    assert np.array(changed.observe_jacobian((3.0, 1.0), ())) == pytest.approx(np.array([[6, 0], [0, 1], [0, 0]]))
    assert changed.transition_jacobian is swing_jacobian


GIVEN = {
    "transition": lambda x, u, c: (0.9 * x[0] + u[0],),
    "observe": lambda x, c: (x[0],),
    "process_noise_cov": [1.0],
    "measurement_noise_cov": [2.0],
    "prior_mean": [0.0],
    "prior_cov": [1.0],
    "outputs": {"y": (Quantity("y", "y", ""), lambda x, c: x[0])},
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Checked(StateSpaceModel):
    """A user's model with a field, a rule and a number of its own."""

    tag: str = ""

    def __post_init__(self):
        """Check, and keep the ratio of Q to R."""
        super().__post_init__()
        if self.process_noise_cov[0, 0] > 5:
            raise ValueError("Q is too large")
        object.__setattr__(self, "ratio", float(self.process_noise_cov[0, 0] / self.measurement_noise_cov[0, 0]))


class WithMore(StateSpaceModel):
    """A user's model that keeps something beside the fields."""

    def __init__(self, **fields):
        """Keep Q once more."""
        super().__init__(**fields)
        object.__setattr__(self, "kept", float(self.process_noise_cov[0, 0]))


def test_a_subclass_checks_and_derives_what_it_does_for_a_new_model():
    model = Checked(**GIVEN, tag="mine")
    other = model.replace(process_noise_cov=[3.0])
    assert (type(other), other.tag, other.ratio) == (Checked, "mine", 1.5)
    refused("Q is too large", model.replace, process_noise_cov=[9.0])
    assert WithMore(**GIVEN).replace(process_noise_cov=[3.0]).kept == 3.0


def test_models_share_nothing_that_can_be_changed():
    model = StateSpaceModel(**GIVEN)
    numbers = model.numbers.copy()
    other = model.replace(process_noise_cov=[3.0])
    for array in (other.measurement_noise_cov, other.prior_mean, other.prior_cov, other.process_noise_cov):
        array += 7.0
    other.outputs.clear()
    assert np.array_equal(model.numbers, numbers) and list(model.outputs) == ["y"]
