"""Derivatives of all filters that have them: values of the filter, scores of SciPy, slopes of differences."""

import dataclasses
from itertools import product

import numpy as np
import pytest

from filters import KalmanFilter, StateSpaceModel, make_filter, run
from filters.pages.page import Page
from filters.sensitivity import likelihood, sensitivity, state_score
from tests.filters.checks import refused
from tests.filters.test_differentiated import swing_if
from tests.filters.test_likelihood import WEIGHTS, directions, scored_data, textbook, two_channels
from tests.filters.test_pages import MADE, assert_slopes, whirl_if, wide_pendulum, with_noise
from tests.filters.test_sensitivity import slopes_of
from tests.models import pendulum, simulated, state_space
from tests.oracles import each_close
from tests.slow import slow_but
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.graphs.graphs import Graph
from thruster_env.graphs.programs import Place, values_of
from thruster_env.model.traced import Traced
from tuning.cli.templates.filter import Template
from tuning.likelihood.gradient import tune_by_gradient
from tuning.plants.auv import find_scenario as find_vehicle
from tuning.plants.thruster import find_scenario
from tuning.problems.data import training_seeds
from tuning.search.space import untuned_choice

KEEPING = ("ekf-robust", "sage-husa", "vb")  # more than mean and covariance
NAMES = ("ekf", "iekf", "ukf", "ckf", *KEEPING)
WRITTEN = ("iterations",)  # parameters that programs are written out for


def made(name, model, **own):
    return make_filter(name, model, **MADE[name] | own)


def differences(value, step):
    """The slope of value(t) at 0, to the fourth order of a step."""
    near, far = (value(step) - value(-step)), (value(2 * step) - value(-2 * step))
    return (8 * near - far) / (12 * step)


def by_noise(model, value):
    """Slopes (B, p) of value(model) along Q and R, by differences."""
    q, r = model.process_noise_cov, model.measurement_noise_cov
    found = []
    for dq, dr in zip(*directions(model), strict=True):
        h = 1e-3 * (np.diag(q).min() if dq.any() else np.diag(r).min())
        found.append(differences(lambda t, dq=dq, dr=dr: value(with_noise(model, q + t * dq, r + t * dr)), h))
    return np.stack(found, axis=1)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize(("name", "make"), [("kf", two_channels), *product(NAMES, (two_channels, wide_pendulum))])
def test_the_likelihood_is_the_filters_and_its_gradient_that_of_differences(name, make):
    model = make()
    keys, inputs, z, _ = scored_data(model, steps=12)

    def value(changed):
        return run(made(name, changed), keys, inputs, z).log_likelihoods.sum(axis=1)

    found = likelihood(model, inputs, z, *directions(model), filter=made(name, make()))
    np.testing.assert_allclose(found.values, value(model), rtol=1e-9)
    assert_slopes(found.gradients, by_noise(model, value))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("score", ["log-score", "squares"])
@pytest.mark.parametrize("name", ["kf", *NAMES])
def test_a_score_is_that_of_the_estimates_and_its_gradient_that_of_differences(name, score):
    model = two_channels() if name == "kf" else wide_pendulum()
    data = scored_data(model, steps=12)

    def value(changed):
        return textbook(changed, lambda model: made(name, model), data, score)

    found = state_score(model, *data[1:], *directions(model), score, WEIGHTS, filter=made(name, model))
    np.testing.assert_allclose(found.values, value(model), rtol=1e-9)
    assert_slopes(found.gradients, by_noise(model, value))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("score", [None, "log-score", "squares"])
@pytest.mark.parametrize("name", KEEPING)
def test_slopes_along_a_filters_own_numbers_are_those_of_differences(name, score):
    model, own = two_channels(), {key: value for key, value in MADE[name].items() if key not in WRITTEN}
    data = scored_data(model, steps=12)

    def value(**changed):
        if score is not None:
            return textbook(model, lambda model: made(name, model, **changed), data, score)
        return run(made(name, model, **changed), *data[:3]).log_likelihoods.sum(axis=1)

    still = np.zeros((len(own), 2, 2))
    more = {"filter": made(name, model), "own_slopes": np.eye(len(own))}
    if score is None:
        found = likelihood(model, *data[1:3], still, still, **more)
    else:
        found = state_score(model, *data[1:], still, still, score, WEIGHTS, **more)
    np.testing.assert_allclose(found.values, value(), rtol=1e-9)
    slopes = [differences(lambda t, key=key: value(**{key: own[key] + t}), 1e-4 * own[key]) for key in own]
    assert_slopes(found.gradients, np.stack(slopes, axis=1))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("decides", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_slopes_along_constants_and_the_prior_are_those_of_differences(name, decides):
    values = {"stiffness": 9.0, "damping": 0.3, "drive": 2.0, "start": 3.0, "spread": 0.5}
    sizes = {"stiffness": 1.0, "damping": 0.1, "drive": 0.5, "start": 0.3, "spread": 0.1}

    def model_of(**changes):
        model = wide_pendulum(**changes)
        return model.replace(transition=whirl_if) if decides else model

    keys, inputs, z, _ = scored_data(model_of(**values), steps=12)

    def value(key, t):
        changed = values | {key: values[key] + t * sizes[key]}
        return run(made(name, model_of(**changed)), keys, inputs, z).log_likelihoods.sum(axis=1)

    slopes = slopes_of(model_of, values, sizes)
    found = sensitivity(model_of(**values), inputs, z, slopes, filter=made(name, model_of(**values)))
    expected = [differences(lambda t, key=key: value(key, t), 1e-3) for key in values]
    assert_slopes(found.gradients, np.stack(expected, axis=1))


def assert_gradient_on(scenario, name, steps):
    """The gradient on two training runs, along each variance of Q and along R."""
    model, data = scenario.model(), scenario.data(training_seeds(0, 2))
    inputs, z = data.inputs[:, :steps], data.measurements[:, : steps + 1]
    q, r = model.process_noise_cov, model.measurement_noise_cov
    dq = np.array([np.diag(row) for row in np.eye(model.n) * np.diag(q)] + [np.zeros_like(q)])
    dr = np.array([np.zeros_like(r)] * model.n + [r])
    moved = [k for k in range(len(dq)) if dq[k].any() or dr[k].any()]
    dq, dr = dq[moved], dr[moved]

    def value(k, t):
        changed = with_noise(model, q + t * dq[k], r + t * dr[k])
        return run(made(name, changed), episode_keys(range(2)), inputs, z).log_likelihoods.sum(axis=1)

    found = likelihood(model, inputs, z, dq, dr, filter=made(name, model))
    np.testing.assert_allclose(found.values, value(0, 0.0), rtol=1e-9)
    expected = np.stack([differences(lambda t, k=k: value(k, t), 1e-4) for k in range(len(dq))], axis=1)
    np.testing.assert_allclose(found.gradients, expected, rtol=0, atol=1e-6 * abs(expected).max())


@pytest.mark.parametrize("name", slow_but(KEEPING, KEEPING[:1]))
def test_on_a_scenario_the_gradient_is_that_of_differences(name):
    assert_gradient_on(find_scenario("outliers"), name, 100)


@pytest.mark.slow
@pytest.mark.parametrize("name", KEEPING[-1:])
def test_on_a_vehicle_the_compiled_gradient_is_that_of_differences(name):
    assert_gradient_on(find_vehicle("auv:motion"), name, 100)


@pytest.mark.parametrize("name", slow_but(KEEPING, KEEPING[:1]))
def test_gradients_tune_such_a_filter(name):
    scenario = find_scenario("outliers")
    data = scenario.data(training_seeds(0, 2))
    found = tune_by_gradient(name, scenario, data, starts=[1.0])
    tuned, untuned = (choice.filter(scenario) for choice in (found.choice, untuned_choice(name, scenario)))
    levels = [run(one, None, data.inputs, data.measurements).log_likelihoods.sum() for one in (tuned, untuned)]
    assert (
        found.best.converged and found.best.value == pytest.approx(levels[0], rel=1e-9) and levels[0] > levels[1]
    )


def test_runs_that_lie_together_begin_with_what_a_filter_keeps_at_its_start():
    model = two_channels()
    _, inputs, z, _ = scored_data(model, count=7, steps=12)
    together = likelihood(model, inputs, z, *directions(model), filter=made("vb", model))
    for b in range(7):
        alone = likelihood(model, inputs[[b]], z[[b]], *directions(model), filter=made("vb", model))
        np.testing.assert_array_equal(together.gradients[b], alone.gradients[0])


def counting(model, x, P, z):
    """The template's update, which counts, forgets what it counted, and keeps a root of Q."""
    done = Template.page.update(model, x, P, z)
    return *done, {"count": model.extras["count"] * 0.0, "root": model.Q_root * 2.0}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Keeping(Template):
    page = Page(
        *Template.page[:2],
        counting,
        initial=lambda model: {"count": model.own.bandwidth, "root": model.prior_root},
    )


@pytest.mark.usefixtures("as_python")
def test_a_users_filter_that_keeps_something_has_the_gradient_of_one_that_does_not():
    model = two_channels()
    _, inputs, z, _ = scored_data(model, steps=12)
    found, expected = (
        likelihood(model, inputs, z, *directions(model), filter=kind(model=model, bandwidth=2.0))
        for kind in (Keeping, Template)
    )
    each_close(found, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("form", ["information", "square-root"])
def test_kalmans_forms_have_the_derivatives_of_the_covariance_form(form):
    model = two_channels()
    _, inputs, z, _ = scored_data(model, steps=12)
    found, expected = (
        likelihood(model, inputs, z, *directions(model), filter=KalmanFilter(model=model, form=one))
        for one in (form, "covariance")
    )
    np.testing.assert_array_equal(found.gradients, expected.gradients)


def test_own_slopes_of_another_size_are_refused():
    model = two_channels()
    inputs, z = simulated(model, 3)
    with pytest.raises(ValueError, match=r"own_slopes must have the shape \(6, 2\), but got \(6, 1\)"):
        likelihood(model, inputs, z, *directions(model), filter=made("vb", model), own_slopes=np.zeros((6, 1)))


def folded(x, c):
    """What a graph makes shorter, if it knows what its arguments are made of."""
    return -x[0], c[0] - x[1], c[0] + x[1], x[1] * c[0], 0.0 - x[0], -x[1]


def test_slopes_along_numbers_that_are_made_of_others_are_found():
    shape = state_space(
        lambda x, u, c: x, folded, q=[1.0, 1.0], r=[1.0] * 6, mean=[0.7, 0.2], cov=[1.0, 1.0], constants=(3.0,)
    ).shape
    graph = Graph()
    a, b, c = (graph.given(Place("numbers", k)) for k in range(3))
    x = np.array([a - b, -a])
    found = Traced(folded, None, "measurement", shape).parts[1](x, None, np.array([c]))
    numbers = [graph.number(one) for one in found.ravel()]
    jacobian = values_of(numbers, np.array([[0.7], [0.2], [3.0]])).reshape(found.shape)
    expected = [[-1, 0], [0, -1], [0, 1], [0, 3], [-1, 0], [0, -1]]
    np.testing.assert_array_equal(jacobian, expected)


def test_conditions_that_are_added_are_traced():
    """Of NumPy's floats, which the comparison with Python was made of, two that hold were 1 and not 2."""
    model = StateSpaceModel(
        transition=lambda x, u, c: ((x[0] > 0.05) + (x[1] > 0.05) + c[0] * (x[0] > -2.0), x[1]),
        observe=lambda x, c: (x[0],),
        process_noise_cov=[1.0, 1.0],
        measurement_noise_cov=[1.0],
        prior_mean=[0.7, 0.2],
        prior_cov=[1.0, 1.0],
        inputs=1,
        constants=(0.5,),
    )
    graph = Graph()
    numbers = np.array([graph.given(Place("numbers", k)) for k in range(4)])
    value = Traced(model.transition, None, "motion", model.shape).parts[0](numbers[:2], numbers[2:3], numbers[3:])
    found = values_of([graph.number(one) for one in value], np.array([[0.7], [0.2], [0.0], [0.5]]))
    np.testing.assert_array_equal(found.ravel(), [2.5, 0.2])


@pytest.mark.parametrize("score", ["log-score", "squares"])
def test_called_and_interpreted_models_have_the_scores_of_traced_ones(score):
    model = pendulum()
    data, slopes = scored_data(model)[1:], list(directions(model))
    traced = state_score(model, *data, *slopes, score)
    with interpreted():
        plain = state_score(model, *data, *slopes, score)
        called = state_score(model.replace(transition=swing_if), *data, *slopes, score)
    for a, b, c in zip(traced, plain, called, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * abs(a).max())
        np.testing.assert_allclose(a, c, rtol=1e-5, atol=1e-5 * abs(a).max())


def test_what_does_not_fit_is_refused():
    model = two_channels()
    inputs, z, x = (one[:2] for one in scored_data(model)[1:])
    q, r = np.zeros((1, 2, 2)), np.zeros((1, 2, 2))
    with pytest.raises(ValueError, match="score must be one of log-score, squares, but got 'mse'"):
        state_score(model, inputs, z, x, q, r, "mse")
    refused("must have the shapes", state_score, model, inputs, z, x[:, 1:], q, r)
    with pytest.raises(ValueError, match=r"weights must have the shape \(2,\), but got \(3,\)"):
        state_score(model, inputs, z, x, q, r, "squares", np.ones(3))
