"""Models of any size: what is written out for small ones is looped over arrays for large ones."""

import sys
from contextlib import contextmanager

import numpy as np
import pytest

from filters import StateSpaceModel, make_filter, run, sensitivity, thruster_model
from filters import bounds as posterior
from filters.augmented import augmented_model
from filters.registry import FILTERS, filter_type
from filters.runs import smooth
from tests.filters.checks import refused
from tests.models import (
    OF_EACH_KIND,
    lonely_model,
    pendulum,
    random_affine,
    simulated,
    state_space,
    varying_noise,
    wide_model,
)
from tests.oracles import each_close
from tests.slow import slow_but
from tests.thruster_env.core.test_angles import turned, turning, turntable
from thruster_env.core import equal_functions, sources
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.model import shape
from thruster_env.model.quantities import Quantity
from thruster_env.model.simulate import simulate
from tuning.problems.check import check_model
from tuning.problems.data import Data

MODELS = {
    "wide affine": wide_model,
    "pendulum": pendulum,
    "thruster": thruster_model,
    "no input": lonely_model,
    "angles": lambda: turning(3.0, wraps=True),
    "angles, affine": lambda: turntable(3.0),
}
FORMS = {
    "kf, information": ("kf", {"form": "information"}),
    "kf, square-root": ("kf", {"form": "square-root"}),
    "ekf, square-root": ("ekf", {"form": "square-root"}),
    "ukf, square-root": ("ukf", {"form": "square-root"}),
    "kf, scheduled": ("kf", {"schedule": 5}),
    "fuzzy, by moments": ("fuzzy", {"blending": "moments"}),
    "enkf, inflated": ("enkf", {"inflation": 1.1, "relaxation": 0.3}),
    "enkf, centred": ("enkf", {"centred_perturbations": 1}),
    "pf, regularised": ("pf", {"regularisation": 1.0, "resampling_threshold": 1.0}),
    "pf, optimal": ("pf", {"proposal": "optimal", "regularisation": 0.5, "smoothed": [-1]}),
    "pf, gaussian": ("pf", {"resampling": "gaussian", "resampling_threshold": 1.0}),
    "apf, regularised": ("apf", {"regularisation": 1.0}),
    "rbpf, the last state": ("rbpf", {"sampled": [-1], "regularisation": 1.0, "resampling_threshold": 1.0}),
}
CASES = {**{name: (name, {}) for name in FILTERS}, **FORMS}
FOR_EVERY_FILTER = "wide affine", "angles"  # the other models have the filters of each kind


def forget_functions():
    """Empty the caches of all makers, which do not know of limits that a test has changed."""
    for name, module in list(sys.modules.items()):
        if name.startswith(("thruster_env.core", "thruster_env.graphs", "thruster_env.model", "filters")):
            for value in list(vars(module).values()):
                getattr(value, "cache_clear", lambda: None)()
    for known in (equal_functions._first, equal_functions._used, equal_functions._copied):
        known.clear()  # a maker's functions of equal arguments are equal there


@contextmanager
def arrays_only():
    """Within this context every vector and matrix is an array, and every sum a loop."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("LARGEST_TUPLE", "LARGEST_SIDE", "LONGEST_TEXT"):
            patch.setattr(sources, name, 0)
        patch.setattr(shape, "MOST_CONSTANTS", 0)
        forget_functions()
        yield
    forget_functions()


def everything(model_name):
    """What filters and what stands beside them make of a model, by name."""
    model, names = MODELS[model_name](), CASES if model_name in FOR_EVERY_FILTER else ("kf", "ekf", *OF_EACH_KIND)
    inputs, z = simulated(model, 6, count=2, level=1.0, missing=0.2)
    keys, found = episode_keys([3, 4]), {}
    found["simulate"] = simulate(model, keys, inputs)
    for name, (kind, numbers) in ((name, CASES[name]) for name in names):
        if filter_type(kind).has_ensemble:
            numbers = {**numbers, "ensemble_size": 10}
        try:
            made = make_filter(kind, model, **numbers)
        except ValueError:  # the model has no operating points, or no range of states
            continue
        noise = varying_noise(model, 6) if made.varying_noise else {}
        found[name] = run(made, keys, inputs, z, **noise)
        belief, _ = made.update(made.predict(made.init((1, 2)), inputs[0, 0]), z[0, 1])
        found[f"{name}, a step"] = belief.mean, belief.cov, belief.members, belief.extras
        try:
            found[f"{name}, smoothed"] = smooth(made, keys, inputs, z, lag=3)
        except ValueError:  # it has no smoother
            continue
    slopes = [np.stack([np.eye(size), np.ones((size, size))]) for size in (model.n, model.m)]
    found["likelihood"] = sensitivity.likelihood(model, inputs, z, *slopes)
    found["bound"] = (posterior.posterior_bound(model, inputs, truths=2),)
    if len(model.constants):
        names = getattr(model.constants, "_fields", range(len(model.constants)))
        known = {names[min(1, len(names) - 1)]: (0.1, 0.01)}
        joint = augmented_model(model, known)
        found["augmented"] = run(make_filter("ekf", joint), keys, inputs, z)
    return found


QUICK = ("angles",)  # a filter's arrays, and the angles among them


@pytest.mark.parametrize("model", slow_but(MODELS, QUICK))
def test_loops_over_arrays_are_what_is_written_out_for_tuples(model):
    with interpreted():
        tuples = everything(model)
        with arrays_only():
            arrays = everything(model)
    assert list(tuples) == list(arrays) and len(arrays) > (75 if model in FOR_EVERY_FILTER else 20)
    for name, expected in tuples.items():
        for one, other in zip(expected, arrays[name], strict=True):
            close = 1e-6 if name == "likelihood" else 1e-9  # it has differences of differences
            atol = close * np.nanmax(
                np.abs(one), initial=1e-3, where=np.isfinite(one)
            )  # some entries are small differences of large ones
            np.testing.assert_allclose(other, one, rtol=close, atol=atol, err_msg=f"{model}, {name}")


def linear(n, m):
    """A stable affine model of n states and m measurements with correlated noise."""
    return random_affine(n, m, 2, seed=5)


LARGE_ENSEMBLES = [(name, 12, 4) for name in ("enkf", "etkf", "ensrf", "denkf", "ienkf")] + [("etkf", 40, 40)]


@pytest.mark.parametrize(("name", "n", "m"), LARGE_ENSEMBLES)
def test_an_ensemble_of_a_large_model_is_updated_by_the_moments_of_its_members(name, n, m):
    model, z = linear(n, m), np.linspace(-1.0, 1.0, m)
    with interpreted():
        made = make_filter(name, model, ensemble_size=6, **({"iterations": 1} if name == "ienkf" else {}))
        before = made.init((1, 2))
        after, innovation = made.update(before, z)
    _, _, _, c, shift = model.matrices()
    x, y = before.members, c @ before.members + shift[:, None]
    covs = np.cov(np.vstack([x, y]))
    s = covs[n:, n:] + model.measurement_noise_cov
    gain = covs[:n, n:] @ np.linalg.inv(s)
    each_close((innovation.cov, innovation.value), (s, z - y.mean(axis=1)), rtol=1e-9)
    np.testing.assert_allclose(after.cov, np.cov(after.members), rtol=1e-9, atol=1e-12)
    if name == "enkf":  # z - v_j - y_j, whatever v_j: each member moves along the columns of the gain
        moves = after.members - x
        along = gain @ np.linalg.lstsq(gain, moves, rcond=1e-10)[0]
        np.testing.assert_allclose(along, moves, atol=1e-7)
        return
    np.testing.assert_allclose(after.mean, x.mean(axis=1) + gain @ (z - y.mean(axis=1)), rtol=1e-7, atol=1e-8)
    expected = covs[:n, :n] - gain @ s @ gain.T
    if name == "denkf":  # half the gain: P - K H P + K H P H'K'/4
        expected = covs[:n, :n] - gain @ covs[n:, :n] + gain @ covs[n:, n:] @ gain.T / 4
    np.testing.assert_allclose(after.cov, expected, rtol=1e-6, atol=1e-7)


def test_rules_of_a_large_affine_model_are_all_its_kalman_filter():
    model, z = linear(40, 40), np.linspace(-1.0, 1.0, 40)
    fuzzy, kf = make_filter("fuzzy", model, premises=[0, 5]), make_filter("kf", model)
    after, innovation = fuzzy.update(fuzzy.predict(fuzzy.init(), [0.3, -0.2]), z)
    expected, of_kf = kf.update(kf.predict(kf.init(), [0.3, -0.2]), z)
    np.testing.assert_allclose(after.mean, expected.mean, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(after.cov, expected.cov, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(innovation.log_likelihood, of_kf.log_likelihood, rtol=1e-9)


def test_loops_over_particles_that_are_cut_know_which_channels_are_measured():
    model, z = linear(14, 14), np.linspace(-1.0, 1.0, 14)
    z[5] = np.nan

    def estimate():
        filter_ = make_filter("pf", model, ensemble_size=10)
        return filter_.update(filter_.predict(filter_.init((1, 2)), [0.3, -0.2]), z)

    (after, innovation), (expected, of_text) = estimate(), interpreted()(estimate)()
    np.testing.assert_allclose(after.mean, expected.mean, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(innovation.log_likelihood, of_text.log_likelihood, rtol=1e-9)


def headings(x, u, c):
    """Forty directions, each of which goes on by a constant, as numbers between -pi and pi."""
    return tuple(turned(direction + c[0]) for direction in x)


def compasses(x, c):
    return tuple(turned(direction + c[0]) for direction in x)


def test_slopes_of_many_angles_are_those_of_an_angle_at_the_cut():
    """By central differences, of states and of a joint parameter, in half the components: others jump there."""
    half = [Quantity(f"heading {i}", f"psi_{i}", "rad", i % 2 == 0) for i in range(40)]
    eye = np.eye(40)
    noise = {"q": np.ones(40), "r": np.ones(40)}
    prior = {"mean": np.full(40, np.pi - 0.5), "cov": np.ones(40)}
    model = state_space(headings, compasses, **noise, **prior, states=half, measurements=half, constants=(0.5,))
    angles, x, scales = np.arange(40) % 2 == 0, model.prior_mean, model.scales
    with interpreted():
        by_state = shape.transition_slopes(model.functions, model.shape)(x, scales, (0.0,), model.constants)
        measured = shape.observation_slopes(model.functions, model.shape)(x, scales, model.constants)
        known = {"transition_jacobian": lambda x, u, c: eye, "observe_jacobian": lambda x, c: eye}
        joint = augmented_model(model.replace(**known), {0: (0.1, 0.01)})
        z = np.append(x, 0.5)
        of_motion = joint.transition_jacobian(z, (0.0,), joint.constants)
        of_compass = joint.observe_jacobian(z, joint.constants)
    for found in (by_state, measured):
        np.testing.assert_allclose(found[angles], eye[angles], atol=1e-7)
        assert (np.diag(found)[~angles] < -1e4).all()
    for found in (of_motion[:40], of_compass):
        np.testing.assert_allclose(found[angles, 40], 1.0, atol=1e-7)
        assert (found[~angles, 40] < -1e4).all()


def test_slopes_of_a_large_analytic_model_are_exact():
    def grow(x, u, c):
        return x * x

    noise = {"q": np.ones(40), "r": [1.0, 1.0]}
    prior = {"mean": np.arange(40.0), "cov": np.ones(40)}
    model = state_space(grow, lambda x, c: (x[0] * x[39], x[1]), **noise, **prior, analytic=True)
    x, expected = model.prior_mean, np.zeros((2, 40))
    expected[0, [0, 39]], expected[1, 1] = (x[39], x[0]), 1.0
    np.testing.assert_allclose(model.transition_jacobian(x, (0.0,), ()), np.diag(2 * x), rtol=1e-15)
    np.testing.assert_allclose(model.observe_jacobian(x, ()), expected, rtol=1e-15)


def test_what_a_large_model_is_and_whether_it_fits_its_data_is_found_with_arrays():
    """Its functions multiply whole states, which tuples refuse."""
    noise = {"process_noise_cov": np.ones(40), "measurement_noise_cov": [1.0]}
    prior = {"prior_mean": np.ones(40), "prior_cov": np.ones(40)}
    model = StateSpaceModel(
        transition=lambda x, u, c: x * x, observe=lambda x, c: (x[0],), inputs=1, **noise, **prior
    )
    assert model.digest != model.replace(transition=lambda x, u, c: x * x * x).digest
    data = Data((1,), np.zeros((1, 2, 1)), np.ones((1, 3, 1)), np.zeros((1, 2)), states=np.ones((1, 3, 40)))
    check_model(model, data, "large")
    with pytest.raises(ValueError, match="transition of the model of problem large must be finite"):
        check_model(model.replace(transition=lambda x, u, c: x / u[0]), data, "large")


def ring(x, u, c):
    """A state that goes round, of any number of components."""
    return np.roll(x, 1) if isinstance(x, np.ndarray) else (x[-1], *x[:-1])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"transition": lambda x, u: x}, r"transition must be a function of \(x, u, c\), but takes \(x, u\)"),
        ({"transition": lambda x, u, c: 1.0}, "must return a tuple or array of 40 states, .* the number 1.0"),
        (
            {"transition": lambda x, u, c: x[1:]},
            "must return a tuple or array of 40 states, .* returned 39 entries",
        ),
        (
            {"observe": lambda x, c: x.first},
            r"must work for 40 states \(x is an array of 40 numbers\) and 1 input",
        ),
        ({"observe": lambda x, c: x}, "observe must return a tuple of 2 measurements, .* returned 40 entries"),
    ],
)
def test_a_wrong_function_of_a_large_model_is_told_in_one_sentence(changes, message):
    functions = {"transition": ring, "observe": lambda x, c: (x[0], x[1])}
    numbers = {"process_noise_cov": np.ones(40), "measurement_noise_cov": [1.0, 1.0]}
    prior = {"prior_mean": np.zeros(40), "prior_cov": np.ones(40), "inputs": 1}
    assert StateSpaceModel(**functions, **numbers, **prior).m == 2
    refused(message, StateSpaceModel, **{**functions, **changes}, **numbers, **prior)
