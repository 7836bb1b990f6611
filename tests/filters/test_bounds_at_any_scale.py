"""Bounds, the filter's forms and smoothers where variances lie many powers of ten apart, and bounds on angles."""

import math
from decimal import Decimal, localcontext

import numpy as np
import pytest

from filters import affine_model, make_filter, run
from filters.bounds import path_bound, posterior_bound, wrapped_variances
from tests.models import affine, state_space
from thruster_env.core.checks import covariance_root
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
