"""The pages of filters beside the extended one: they are the filters, and their slopes those of differences."""

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest

from filters import FILTERS, ExtendedKalmanFilter, KalmanFilter, differentiated, make_filter, run, thruster_model
from filters.differentiated import AT_ONCE, Wanted, recursion_of
from filters.filter import PageFilter
from filters.pages.page import called_at_points
from filters.sensitivity import (
    KINDS,
    ModelSlopes,
    differentiable,
    information,
    likelihood,
    sensitivity,
    state_score,
)
from tests.filters.checks import refused
from tests.filters.of_arrays import run_page
from tests.filters.test_differentiated import units
from tests.filters.test_likelihood import directions, scored_data, two_channels
from tests.filters.test_sensitivity import pendulum as turning_pendulum
from tests.filters.test_sensitivity import ring, turn
from tests.models import plane_model, random_affine, simulated, wide_model
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys

NAMES = ("iekf", "ukf", "ckf")
CHANGED = {"iekf": {"iterations": 3}, "ukf": {"alpha": 0.8, "beta": 1.5, "kappa": 1.0}, "ckf": {}}


def whirl(x, u, c):
    """The pendulum with its angle in (-pi, pi]."""
    angle, rate = turn(x, u, c)
    return math.atan2(math.sin(angle), math.cos(angle)), rate


def whirl_slopes(x, u, c):
    return (1.0, 0.1), (-0.1 * c.stiffness * math.cos(x[0]), 1.0 - 0.1 * c.damping)


def gaze(x, c):
    """The bearing of the pendulum's mass from below its pivot, and the rate with a bias."""
    return math.atan2(math.sin(x[0]), math.cos(x[0]) + 0.4), x[1] + c.offset + 0.3 * math.cos(x[0])


def gaze_slopes(x, c):
    cosine = math.cos(x[0])
    return ((1.0 + 0.4 * cosine) / (1.16 + 0.8 * cosine), 0.0), (-0.3 * math.sin(x[0]), 1.0)


def wide_pendulum(**changes):
    """The pendulum on top, where its angle wraps; points of it are more than half a turn apart."""
    model = turning_pendulum(**{"start": 3.0, "spread": 2.0, **changes})
    functions = {"transition": whirl, "transition_jacobian": whirl_slopes, "observe": gaze}
    return model.replace(**functions, observe_jacobian=gaze_slopes, analytic=False)


def made(name, model):
    """A filter with parameters of its own."""
    return make_filter(name, model, **CHANGED[name])


def with_noise(model, q, r):
    return model.replace(process_noise_cov=q, measurement_noise_cov=r)


def assert_slopes(found, expected, accuracy=1e-6):
    assert abs(expected).max(axis=0).all()
    for one, other in zip(found.T, expected.T, strict=True):
        np.testing.assert_allclose(one, other, rtol=accuracy, atol=accuracy * abs(other).max())


MADE = {
    "kf": {},
    "kf-steady": {},
    "ekf": {},
    **CHANGED,
    "fading": {"fading": 1.1},
    "h-infinity": {"theta": 0.002},
    "schmidt": {"considered": [0]},
    "ekf-robust": {"degrees_of_freedom": 3.0, "iterations": 3},
    "sage-husa": {"forgetting_factor": 0.9, "process_forgetting_factor": 0.8},
    "vb": {"forgetting_factor": 0.9, "prior_weight": 6.0, "iterations": 2},
}


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("make", [wide_model, wide_pendulum])
@pytest.mark.parametrize("name", MADE)
def test_a_page_of_arrays_is_the_filter(name, make):
    model = make()
    if name.startswith("kf") and make is wide_pendulum:
        model = model.replace(operating_state=[0.0, 0.0], operating_input=[0.0])
    assert_page_is_the_filter(make_filter(name, model, **MADE[name]))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("form", ["information", "square-root"])
def test_a_page_of_another_form_is_that_form(form):
    assert_page_is_the_filter(KalmanFilter(model=wide_model(), form=form))


@pytest.mark.usefixtures("as_python")
def test_a_page_of_a_schedule_is_the_scheduled_filter():
    assert_page_is_the_filter(KalmanFilter(model=thruster_model(), schedule=4))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", ["ekf-robust", "sage-husa", "vb", "square-root", "information"])
def test_a_filter_of_a_model_that_is_called_is_that_of_one_that_is_traced(name):
    forms, inputs_and_z = ("square-root", "information"), simulated(turning_pendulum(), 12, count=2, missing=0.3)
    found = []
    for function in (turn, turn_if):
        model = turning_pendulum().replace(transition=function)
        if name in forms:
            filter_ = Formed(model=model, form=name)
        else:
            filter_ = make_filter(name, model, **MADE[name])
        assert bool(filter_.kernels().vectors) is (function is turn)
        found.append(run(filter_, None, *inputs_and_z))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


def turn_if(x, u, c):
    """The pendulum, by a function that cannot be traced."""
    return (0.0, 0.0) if int(abs(x[1]) > 1e6) else turn(x, u, c)


@dataclass(frozen=True, kw_only=True, eq=False)
class Formed(ExtendedKalmanFilter):
    """The extended filter in all forms of the Kalman filter."""

    forms = KalmanFilter.forms


def test_all_filters_with_pages_are_tried():
    assert set(MADE) == {kind.name for kind in FILTERS.values() if issubclass(kind, PageFilter)}


def assert_page_is_the_filter(filter_):
    inputs, z = simulated(filter_.model, 12, missing=0.3)
    estimates = run(filter_, episode_keys([0]), inputs, z)
    with np.errstate(divide="ignore"):  # of a number that is not chosen
        found = run_page(filter_, inputs[0], z[0])
    for one, other in zip(found, estimates, strict=False):
        np.testing.assert_allclose(one, other[0], rtol=1e-10, atol=1e-11)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", NAMES)
def test_of_an_affine_model_all_filters_have_the_derivatives_of_kalmans(name):
    model = two_channels()
    _, inputs, z, x = scored_data(model, steps=12)
    slopes = tuple(map(np.array, directions(model)))
    filters = [KalmanFilter(model=model), made(name, model)]
    for work in (likelihood, lambda *given, **used: [information(*given, **used)]):
        kalman, other = (work(model, inputs, z, *slopes, filter=one) for one in filters)
        for a, b in zip(kalman, other, strict=True):
            np.testing.assert_allclose(b, a, rtol=1e-10, atol=1e-10 * abs(a).max())
    kalman, other = (state_score(model, inputs, z, x, *slopes, filter=one) for one in filters)
    np.testing.assert_allclose(other.gradients, kalman.gradients, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_the_interpreted_likelihood_is_the_compiled_one(name):
    model = wide_pendulum()
    _, inputs, z, _ = scored_data(model, steps=12)
    slopes = tuple(map(np.array, directions(model)))
    compiled = likelihood(model, inputs, z, *slopes, filter=make_filter(name, model))
    alone = likelihood(model, inputs[3:4], z[3:4], *slopes, filter=make_filter(name, model))
    np.testing.assert_array_equal(compiled.gradients[3], alone.gradients[0])
    with interpreted():
        plain = likelihood(model, inputs, z, *slopes, filter=make_filter(name, model))
    for a, b in zip(compiled, plain, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10 * abs(b).max())


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", NAMES)
def test_a_state_that_is_known_does_not_matter_until_a_parameter_makes_it_unknown(name):
    model = plane_model(a=[[0.9, 0.3], [0.0, 1.0]], process_noise_cov=[0.3, 0.0], prior_cov=[1.0, 0.0])
    _, inputs, z, _ = scored_data(model, steps=12)
    q, r = np.array([np.diag([1.0, 0.0]), np.diag([0.0, 1.0]), np.zeros((2, 2))]), np.zeros((3, 2, 2))
    r[2] = np.eye(2)
    kalman, other = (likelihood(model, inputs, z, q, r, filter=one) for one in (None, made(name, model)))
    there = [0, 2]
    np.testing.assert_allclose(other.gradients[:, there], kalman.gradients[:, there], rtol=1e-9)
    assert np.isfinite(kalman.gradients).all()
    assert np.isnan(other.gradients[:, 1]).all() == (name != "iekf")  # roots have no slope there


@pytest.mark.usefixtures("as_python")
def test_parameters_of_a_filter_reach_its_page():
    model = wide_pendulum()
    _, inputs, z, _ = scored_data(model, steps=12)
    slopes = tuple(map(np.array, directions(model)))
    of = {
        (name, k): likelihood(model, inputs, z, *slopes, filter=make_filter(name, model, **own)).gradients
        for name, k, own in [
            ("ekf", 0, {}),
            ("iekf", 1, {"iterations": 1}),
            ("iekf", 2, {"iterations": 2}),
            ("ukf", 1, {"alpha": 0.5}),
            ("ukf", 2, {"alpha": 0.6}),
        ]
    }
    np.testing.assert_allclose(of["iekf", 1], of["ekf", 0], rtol=1e-12, atol=1e-12)
    assert abs(of["iekf", 2] - of["ekf", 0]).max() > 1e-3 < abs(of["ukf", 1] - of["ukf", 2]).max()
    of_another = make_filter("ukf", wide_model(), alpha=0.5)  # its spread depends on the number of states
    found = likelihood(model, inputs, z, *slopes, filter=of_another).gradients
    np.testing.assert_array_equal(found, of["ukf", 1])
    pages = [differentiable(model, make_filter("ukf", model, alpha=alpha)).page for alpha in (0.5, 0.6)]
    assert pages[0] == pages[1]  # one program for both


@pytest.mark.usefixtures("as_python")
def test_kalmans_filter_of_a_nonlinear_model_is_that_of_its_affine_one():
    model = thruster_model()
    inputs, z = simulated(model, 8, count=2)
    q, r = units(model)
    found = likelihood(model, inputs, z, q, r, filter=KalmanFilter(model=model))
    expected = run(KalmanFilter(model=model), episode_keys(range(2)), inputs, z).log_likelihoods.sum(axis=1)
    np.testing.assert_allclose(found.values, expected, rtol=1e-10)
    assert abs(likelihood(model, inputs, z, q, r).values / expected - 1).max() > 1e-6
    unmoved = ModelSlopes(np.zeros((3, len(model.constants))), q, r, np.zeros((3, 2)), 0.0 * q)
    with pytest.raises(ValueError, match="of a filter of the model itself"):
        sensitivity(model, inputs, z, unmoved, filter=KalmanFilter(model=model))


def test_filters_without_a_page_are_refused():
    model = two_channels()
    given = (model, np.zeros((1, 2, 1)), np.zeros((1, 3, 2)), np.zeros((1, 2, 2)), np.zeros((1, 2, 2)))
    names = "kf, ekf, iekf, ukf, ckf, fading, h-infinity, schmidt, ekf-robust, sage-husa, vb"
    rule = f"a filter with derivatives must be one of {names}, but got "
    assert ", ".join(kind.name for kind in KINDS) in rule
    refused(f"{rule}'enkf'", likelihood, *given, filter=make_filter("enkf", model))
    refused("filter must be an object that make_filter returns, but got 'ukf'", likelihood, *given, filter="ukf")
    scheduled = KalmanFilter(model=thruster_model(), schedule=3)
    refused("must have schedule=1, but got 3", likelihood, *given, filter=scheduled)
    three = make_filter("ukf", wide_model(), kappa=-2.5)
    refused("kappa must be above minus the number of states, -2, but got -2.5", likelihood, *given, filter=three)


PLAIN = Wanted(information=False, constants=False, tails=False)


def whirl_if(x, u, c):
    """The pendulum, by a function that cannot be traced."""
    return (0.0, 0.0) if int(abs(x[1]) > 1e6) else whirl(x, u, c)


def at_once(model, filter_):
    used, page, _ = differentiable(model, filter_)
    return recursion_of(used.functions, used.shape, PLAIN, page, True).at_once


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", NAMES)
def test_functions_that_are_called_have_the_derivatives_of_those_that_are_traced(name):
    model = wide_pendulum()
    decides = model.replace(transition=whirl_if)
    _, inputs, z, x = scored_data(model, steps=12)
    slopes = tuple(map(np.array, directions(model)))
    assert (at_once(model, made(name, model)), at_once(decides, made(name, decides))) == (
        AT_ONCE,
        1,
    )
    for work in (likelihood, partial(state_score, states=x)):
        given = {"inputs": inputs, "measurements": z, "q_slopes": slopes[0], "r_slopes": slopes[1]}
        traced, called = (work(one, **given, filter=made(name, one)) for one in (model, decides))
        np.testing.assert_allclose(called.values, traced.values, rtol=1e-11)
        assert_slopes(called.gradients, traced.gradients, 1e-8)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", NAMES)
def test_a_model_that_is_too_large_to_be_written_out_is_called(name, monkeypatch):
    monkeypatch.setattr(differentiated, "most_operations", lambda shape: 50)
    recursion_of.cache_clear()
    model = random_affine(n=7, m=2, p=1)  # its matrices are arrays
    inputs, z = simulated(model, 3, count=2, missing=0.2)
    slopes = units(model)
    slopes = slopes[0], np.array([np.zeros((2, 2))] * 7 + [np.eye(2)])
    assert at_once(model, made(name, model)) == 1
    kalman, other = (likelihood(model, inputs, z, *slopes, filter=one) for one in (None, made(name, model)))
    recursion_of.cache_clear()
    np.testing.assert_allclose(other.values, kalman.values, rtol=1e-11)
    np.testing.assert_allclose(other.gradients, kalman.gradients, rtol=1e-7, atol=1e-7)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("points", [3, 40])
def test_the_slope_of_points_goes_the_short_way_over_the_cut(points):
    model = wide_pendulum()
    values, slopes = called_at_points(model.functions, model.shape, "sight", False, points)
    x, dx = (np.tile([[a], [b]], points) for a, b in ((math.pi, 1.0), (1.0, 0.5)))
    seen, expected = gaze(x[:, 0], model.constants), np.array(gaze_slopes(x[:, 0], model.constants)) @ dx[:, 0]
    np.testing.assert_allclose(np.array(values(x, model.constants)).T, [seen] * points)
    found = np.array(slopes(x, np.ones(2), model.constants, dx))
    np.testing.assert_allclose(found.T, [expected] * points, rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES[:1])
def test_forty_states_have_the_derivatives_of_kalmans_filter(name):
    model = ring(40)
    inputs, z = simulated(model, 20, count=2, missing=0.2)
    q, r = np.array([np.eye(40), np.zeros((40, 40))]), np.array([np.zeros((20, 20)), np.eye(20)])
    kalman, other = (likelihood(model, inputs, z, q, r, filter=one) for one in (None, made(name, model)))
    np.testing.assert_allclose(other.values, kalman.values, rtol=1e-11)
    np.testing.assert_allclose(other.gradients, kalman.gradients, rtol=1e-7)
