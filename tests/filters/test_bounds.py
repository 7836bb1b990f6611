"""Bounds: Riccati's recursion at any scale, naive loops along a path, parts of a large model, errors of angles."""

import math
from collections import namedtuple
from decimal import Decimal, localcontext

import numpy as np
import pytest

from filters import affine_model, bounds, make_filter, run
from filters.bounds import path_bound, posterior_bound, posterior_variances, riccati_covariances, wrapped_variances
from tests.filters.checks import refused
from tests.models import affine, state_space
from thruster_env.core.checks import covariance_root
from thruster_env.thruster.model import thruster_model
from tuning.plants.thruster import find_scenario
from tuning.problems import model_problem
from tuning.problems.model_problem import ModelProblem

pytestmark = pytest.mark.usefixtures("as_python")
STEPS = 25
POWERS = -20, -12, -6, 0, 4
VELOCITY = [[1.0, 1.0], [0.0, 1.0]]
ACCELERATION = [[1.0, 0.1, 0.005], [0.0, 1.0, 0.1], [0.0, 0.0, 1.0]]
CASES = {  # F, H, R and the prior's variances
    "constant velocity": (VELOCITY, [1.0, 0.0], 1.0, [1.0, 1.0]),
    "precise sensor": (VELOCITY, [1.0, 0.0], 1e-6, [100.0, 1.0]),
    "constant acceleration": (ACCELERATION, [1.0, 0.0, 0.0], 0.04, [1.0, 1.0, 1.0]),
    "stiff": ([[0.999, 1e-3], [0.0, 1e-9]], [1.0, 0.0], 1.0, [1.0, 1.0]),
    "unobservable position": (VELOCITY, [0.0, 1.0], 1.0, [1.0, 1.0]),
}


def exact_covariances(f, h, r, prior, q, steps=STEPS):
    """The covariance after each measurement with 80 digits, (K + 1, n, n)."""
    with localcontext(prec=80):
        f, p, q = ([[Decimal(float(v)) for v in row] for row in part] for part in (f, np.diag(prior), q))
        h, found = [Decimal(v) for v in h], []
        places = range(len(h))
        for k in range(steps + 1):
            if k:
                moved = [[sum(f[i][a] * p[a][j] for a in places) for j in places] for i in places]
                p = [[q[i][j] + sum(moved[i][a] * f[j][a] for a in places) for j in places] for i in places]
            seen = [sum(p[i][a] * h[a] for a in places) for i in places]
            s = sum(h[a] * seen[a] for a in places) + Decimal(r)
            p = [[p[i][j] - seen[i] * seen[j] / s for j in places] for i in places]
            found.append([[float(v) for v in row] for row in p])
    return np.array(found)


def linear(case, q):
    f, h, r, prior = CASES[case]
    n = len(f)
    model = affine(f, np.zeros((n, 0)), [h], q=q, r=[r], mean=np.zeros(n), cov=prior)
    return model, exact_covariances(f, h, r, prior, q)


def apart(found, exact):
    """The largest difference of covariances in units of the states' deviations."""
    deviations = np.sqrt(np.einsum("kii->ki", exact))
    return np.abs((found - exact) / deviations[:, :, None] / deviations[:, None, :]).max()


def noises(n, correlation):
    """Covariances whose first and last variance are of any two sizes."""
    for first in POWERS:
        for last in POWERS:
            if correlation and first > last:
                continue
            roots = 10.0 ** (np.array([first, *[-9] * (n - 2), last]) / 2.0)
            yield np.outer(roots, roots) * (np.eye(n) * (1.0 - correlation) + correlation)


@pytest.mark.parametrize("correlation", [0.0, 0.9])
@pytest.mark.parametrize("case", CASES)
def test_the_bounds_are_riccatis_recursion_whatever_the_sizes_in_q(case, correlation):
    inputs = np.zeros((1, STEPS, 0))
    for q in noises(len(CASES[case][0]), correlation):
        model, exact = linear(case, q)
        assert apart(posterior_bound(model, inputs, truths=2)[0], exact) < 1e-10, q
        assert apart(path_bound(model, inputs)[0], exact) < 1e-7, q


@pytest.mark.parametrize("case", ["constant velocity", "stiff"])
@pytest.mark.parametrize("r", [1e-20, 1.0])
@pytest.mark.parametrize("q", [np.zeros((2, 2)), np.diag([0.0, 1e-18]), 1e-8 * np.outer([0.5, 1.0], [0.5, 1.0])])
def test_the_path_bound_holds_for_a_singular_q_and_a_sensor_without_noise(monkeypatch, case, r, q):
    f, h, _, prior = CASES[case]
    monkeypatch.setitem(CASES, case, (f, h, r, prior))
    model, exact = linear(case, q)
    deviations = np.sqrt(np.maximum(np.einsum("kii->ki", exact), 1e-300))
    off = (path_bound(model, np.zeros((1, STEPS, 0)))[0] - exact) / deviations[:, :, None] / deviations[:, None, :]
    assert np.abs(off).max() < 1e-7


@pytest.mark.parametrize("form", ["covariance", "information", "square-root"])
def test_each_form_of_the_kalman_filter_has_the_covariance_of_riccati(form):
    inputs, nothing = np.zeros((1, STEPS, 0)), np.zeros((1, STEPS + 1, 1))
    for q in noises(2, 0.0):
        model, exact = linear("constant velocity", q)
        found = run(make_filter("kf", model, form=form), np.zeros((1, 2)), inputs, nothing)
        assert found.divergences[0] == 0 and apart(found.covs[0], exact) < 1e-6, q


def test_the_issues_example_has_the_kalman_filters_own_error():
    model, exact = linear("constant velocity", np.diag([1e-12, 1e-2]))
    found = np.sqrt(np.diag(posterior_bound(model, np.zeros((1, STEPS, 0)))[0, -1]))
    np.testing.assert_allclose(found, np.sqrt(np.diag(exact[-1])), rtol=1e-10)


def test_rounding_of_slopes_by_differences_is_no_information():
    def move(x, u, c):
        return x[0] + x[1], x[1]

    def model(**known):
        prior = {"mean": [1e6, 0.1], "cov": [1.0, 0.01]}
        return state_space(move, lambda x, c: (x[0],), q=[1e-16, 1e-4], r=[1.0], **prior, inputs=0, **known)

    inputs = np.zeros((1, STEPS, 0))
    told = model(transition_jacobian=lambda x, u, c: ((1.0, 1.0), (0.0, 1.0)))
    found, exact = (posterior_bound(one, inputs, truths=20)[0] for one in (model(), told))
    assert apart(found, exact) < 1e-4


def test_a_state_too_uncertain_for_float64_has_no_bound_rather_than_a_wrong_one():
    model = affine([[1e30]], np.zeros((1, 0)), [[0.0]], q=[1.0], r=[1.0], mean=[0.0], cov=[1.0])
    found = posterior_bound(model, np.zeros((1, 8, 0)), truths=2)[0, :, 0, 0]
    assert found[1] == pytest.approx(1e60) and not np.isfinite(found[-1])


def test_roots_of_correlated_covariances_do_not_depend_on_units():
    for q in noises(3, 0.9):
        root = covariance_root(q)
        units = np.sqrt(np.diag(q))
        np.testing.assert_allclose(root @ root.T / units / units[:, None], q / units / units[:, None], atol=1e-13)


def oscillator(variance):
    """The least mean square on the circle of information 1/variance, by differences on a grid."""
    count = 161
    grid = np.linspace(-np.pi, np.pi, count, endpoint=False)
    width = grid[1] - grid[0]
    second = (np.eye(count, k=1) + np.eye(count, k=-1) - 2.0 * np.eye(count)) / width**2
    second[0, -1] = second[-1, 0] = 1.0 / width**2
    best = 0.0
    for mu in np.geomspace(0.5 * variance, 1.5 * variance**2, 8):
        best = max(best, np.linalg.eigvalsh(np.diag(grid**2) - 4.0 * mu * second)[0] - mu / variance)
    return best


def test_the_bound_of_a_wrapped_error_is_the_ground_state_on_the_circle():
    for variance in (0.5, 4.0):
        found = wrapped_variances(np.array([variance]), [True])[0]
        assert found * (1.0 - 0.02) < oscillator(variance) < found * (1.0 + 1e-3)
    variances = np.geomspace(1e-12, 1e12, 400)[:, None] * [1.0, 1.0]
    found = wrapped_variances(variances, [True, False])
    assert (np.diff(found[:, 0]) > 0.0).all() and (found[:, 0] <= np.minimum(variances[:, 0], np.pi**2 / 3)).all()
    np.testing.assert_array_equal(found[:, 1], variances[:, 1])
    small = variances[:, 0] < 0.1
    np.testing.assert_array_equal(found[small, 0], variances[small, 0])
    np.testing.assert_allclose(found[-1, 0], np.pi**2 / 3, rtol=1e-5)
    with np.errstate(all="raise"):
        assert np.isnan(wrapped_variances(np.array([np.nan]), [True]))[0]


def heading(noise):
    """A heading that only a gyroscope is known of: no measurement tells it."""
    return affine_model(
        a=[[1.0, 0.1], [0.0, 0.9]],
        b=np.zeros((2, 0)),
        c=[[0.0, 1.0]],
        process_noise_cov=[noise, 1e-4],
        measurement_noise_cov=[1e-4],
        prior_mean=[3.0, 0.0],
        prior_cov=[noise, 1e-4],
        states=[("heading", "psi", "rad", True), ("rate", "r", "rad/s")],
    )


@pytest.mark.parametrize("noise", [1e-4, 0.1])
def test_no_filter_is_better_than_the_bound_on_a_heading_that_drifts(noise):
    problem = ModelProblem(heading(noise), steps=60, first_scored_step=50)
    data = problem.data(range(1))
    bound = problem.bound(data)[0]
    plain = posterior_bound(problem.truth, data.inputs, truths=2)[0, data.late, 0, 0]
    # The Kalman filter is the best there is, its errors are normal, and wrapped as every score wraps them.
    errors = np.random.default_rng(0).normal(size=(2000, len(plain))) * np.sqrt(plain)
    squares = (errors - 2.0 * np.pi * np.round(errors / (2.0 * np.pi))) ** 2
    least = squares.mean() - 3.9 * squares.std() / math.sqrt(squares.size)
    most = squares.mean() + 3.9 * squares.std() / math.sqrt(squares.size)
    assert 0.9 * bound**2 < most and bound <= np.pi / math.sqrt(3.0)
    if noise < 1e-3:
        assert bound == pytest.approx(math.sqrt(plain.mean()), rel=1e-12) and least < bound**2 < most
    else:
        assert bound**2 < least < most < plain.mean() / 1.2  # why the plain one is no bound on wrapped errors


def test_the_open_loops_error_of_an_angle_goes_the_short_way_round(monkeypatch):
    monkeypatch.setattr(model_problem, "SCALE_SEEDS", range(20))
    truth = heading(1e-6).replace(process_noise_cov=[1e-6, 0.0], prior_mean=[math.pi, 0.0])
    problem = ModelProblem(truth, steps=60, first_scored_step=50)
    assert np.isnan(problem.bound(problem.data(range(2)))).all()
    assert problem.scale[0] < 0.1


def naive(model, inputs, missing):
    x, p, found = np.array(model.prior_mean), np.array(model.prior_cov), []
    for k in range(len(inputs) + 1):
        if k > 0:
            for _ in range(model.substeps):
                f = np.array(model.transition_jacobian(tuple(x), tuple(inputs[k - 1]), model.constants))
                x, p = np.array(model.transition(tuple(x), tuple(inputs[k - 1]), model.constants)), f @ p @ f.T
            p = p + model.process_noise_cov
        h = np.array(model.observe_jacobian(tuple(x), model.constants))[~missing[k]]
        r = model.measurement_noise_cov[~missing[k]][:, ~missing[k]]
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        p = p - gain @ h @ p
        found.append(p)
    return np.array(found)


@pytest.mark.parametrize("sensors", [["thrust"], ["thrust", "speed"]])
def test_the_bound_is_the_naive_recursion_also_where_measurements_are_missing(sensors):
    model = find_scenario("nominal").replace(sensors=sensors, measurement_noise_cov=[0.25] * len(sensors)).model()
    rng = np.random.default_rng(0)
    inputs, missing = rng.uniform(-12, 12, (2, 30, 1)), rng.random((2, 31, len(sensors))) < 0.4
    found = path_bound(model, inputs, missing)
    for b in range(2):
        np.testing.assert_allclose(found[b], naive(model, inputs[b], missing[b]), rtol=1e-8, atol=1e-15)
    whole = np.zeros_like(missing[0])
    np.testing.assert_allclose(path_bound(model, inputs)[1], naive(model, inputs[1], whole), rtol=1e-8, atol=1e-15)


def test_for_a_linear_model_it_tends_to_the_steady_state_and_is_the_posterior_bound():
    model = find_scenario("published_tunnel").model()
    inputs = np.zeros((1, 60, 1))
    found = path_bound(model, inputs)[0]
    np.testing.assert_allclose(found[-1], riccati_covariances(model)[1], rtol=1e-10)
    np.testing.assert_allclose(found, posterior_bound(model, inputs, truths=2)[0], rtol=1e-8)


INPUTS = np.repeat(np.random.default_rng(3).uniform(-12, 12, size=(5, 4, 1)), 3, axis=1)


@pytest.mark.parametrize(("bytes_", "work"), [(1, 2e9), (2**28, 8 * 5 * 13 * 3), (1, 1)])
def test_in_parts_they_are_those_of_the_whole_bound_to_the_bit(monkeypatch, bytes_, work):
    model = thruster_model()
    whole = np.einsum("bkii->bki", posterior_bound(model, INPUTS, truths=7, seed=2))
    monkeypatch.setattr(bounds, "MOST_BYTES", bytes_)
    monkeypatch.setattr(bounds, "WORK_AT_ONCE", work)
    monkeypatch.setattr(bounds, "cores", lambda: 2)
    np.testing.assert_array_equal(posterior_variances(model, INPUTS, truths=7, seed=2), whole)


def test_of_a_large_model_the_work_limits_the_sequences_and_equal_ones_are_one(monkeypatch):
    inputs = np.arange(40.0)[:, None, None] * np.ones((40, 150, 2))
    sized = namedtuple("Sized", "n substeps", defaults=(1,))
    assert len(bounds.sequences_taken(inputs, 100, sized(12))) == 40
    assert bounds.sequences_taken(inputs, 100, sized(40)).tolist() == [2 * i for i in range(20)]
    assert bounds.sequences_taken(inputs, 100, sized(500)).tolist() == [0]
    assert bounds.sequences_taken(inputs, 100, sized(2, 100)).tolist() == [2 * i for i in range(20)]
    for same in (inputs[:, :, :0], 0 * inputs):
        assert bounds.sequences_taken(same, 100, sized(13)).tolist() == [0]
    model, some = thruster_model(), [0, 2]
    monkeypatch.setattr(bounds, "ALL_UP_TO", 1)
    monkeypatch.setattr(bounds, "MOST_WORK", 2 * 7 * 12 * 8)
    whole = np.einsum("bkii->bki", posterior_bound(model, INPUTS, truths=7))
    np.testing.assert_array_equal(posterior_variances(model, INPUTS, truths=7), whole[some])


def test_a_nearly_singular_q_loses_no_digits_and_a_singular_one_has_no_bound():
    def tracker(jitter):
        g = np.array([0.5, 1.0])
        noise = {"q": 0.04 * np.outer(g, g) + jitter * np.eye(2), "r": [2.0]}
        prior = {"mean": [0.0, 0.0], "cov": [100.0, 4.0]}
        return affine([[1.0, 1.0], [0.0, 1.0]], [[0.0], [0.0]], [[1.0, 0.0]], **noise, **prior)

    inputs = np.zeros((1, 100, 1))
    for jitter in (1e-2, 1e-7, 1e-11):
        model = tracker(jitter)
        steady = riccati_covariances(model)[1]
        np.testing.assert_allclose(posterior_bound(model, inputs, truths=3)[0, -1], steady, rtol=1e-6)
    assert bounds.has_bound(np.diag([1e-9, 1e9])) and not bounds.has_bound(np.diag([0.0, 1.0]))
    refused("positive definite Q", posterior_bound, tracker(1e-17), inputs)
