"""Covariances are checked by their correlations: a change of units accepts and refuses the same ones."""

import numpy as np
import pytest

from filters import make_filter
from filters.estimators.foreign import Checks
from tests.models import plane_model, random_affine
from thruster_env.core.checks import correlation_flaws, covariance
from thruster_env.model.continuous import densities_of, noise_of_densities

BLOCK = np.array([[1.0, 2.0], [2.0, 1.0]])  # indefinite
SCALES = (1e-9, 1e-3, 1.0, 3e4, 1e9)


def in_units(cov, *units):
    return cov * np.outer(units, units)


def beside(block, variance):
    """A block, and a state of another size by itself."""
    found = np.zeros((3, 3))
    found[:2, :2], found[2, 2] = block, variance
    return found


@pytest.mark.parametrize("variance", [1e-12, 1.0, 1e16])
@pytest.mark.parametrize(
    "block",
    [BLOCK, [[1.0, 0.5], [0.4, 1.0]], [[0.0, 1e-5], [1e-5, 1.0]], [[-1e-6, 0.0], [0.0, 1.0]]],
    ids=["indefinite", "asymmetric", "zero variance", "negative variance"],
)
def test_what_is_no_covariance_is_refused_whatever_stands_beside_it(block, variance):
    for scale in SCALES:
        with pytest.raises(ValueError, match="must be"):
            covariance("Q", beside(scale * np.array(block), variance), 3)


@pytest.mark.parametrize("singular", [False, True])
def test_covariances_of_any_units_are_accepted(singular):
    rng = np.random.default_rng(1)
    for _ in range(200):
        n = int(rng.integers(1, 8))
        root = rng.normal(size=(n, n - 1 if singular and n > 1 else n))
        cov = in_units(root @ root.T, *(10.0 ** rng.uniform(-9.0, 9.0, n)))
        np.testing.assert_allclose(covariance("Q", cov, n), cov, rtol=1e-12)
        if not singular:
            covariance("R", cov, n, positive_definite=True)
        elif n > 1:
            with pytest.raises(ValueError, match="R must be positive definite"):
                covariance("R", cov, n, positive_definite=True)


def test_the_least_eigenvalue_of_correlations_is_the_same_in_all_units():
    rng = np.random.default_rng(2)
    for _ in range(200):
        n = int(rng.integers(1, 6))
        half = rng.normal(size=(n, n))
        cov = half + half.T + n * np.eye(n) * rng.uniform(0.1, 2.0)
        units = 10.0 ** rng.uniform(-9.0, 9.0, n)
        expected = (
            np.linalg.eigvalsh(cov / np.sqrt(np.outer(*[np.diag(cov)] * 2)))[0]
            if np.diag(cov).min() > 0
            else -np.inf
        )
        for one in (cov, in_units(cov, *units)):
            least, asymmetry = correlation_flaws(one)
            assert least == pytest.approx(expected, abs=1e-12) and asymmetry < 1e-12


def test_of_many_covariances_each_has_its_flaw():
    covs = np.array([np.eye(2), BLOCK, [[1.0, 0.1], [0.3, 1.0]], np.zeros((2, 2))])
    least, asymmetry = correlation_flaws(covs)
    np.testing.assert_allclose(least, [1.0, -1.0, 0.8, 0.0])
    np.testing.assert_allclose(asymmetry, [0.0, 0.0, 0.2, 0.0])


@pytest.mark.usefixtures("as_python")
def test_models_filters_and_beliefs_have_this_rule():
    model = plane_model(measurement_noise_cov=[1e-8, 1e8])
    with pytest.raises(ValueError, match="measurement_noise_cov must be positive definite"):
        model.replace(measurement_noise_cov=[[1e-8, 1.0], [1.0, 1e8]])
    large = random_affine(3, 2, 1)
    for name in ("process_noise_cov", "prior_cov"):
        with pytest.raises(ValueError, match=f"{name} must be positive semidefinite"):
            large.replace(**{name: beside(BLOCK, 1e16)})
    filter_ = make_filter("kf", large)
    belief, session = filter_.init(), filter_.session()
    with pytest.raises(ValueError, match="process_noise_cov must be positive semidefinite"):
        session.set_noise(process_noise_cov=beside(BLOCK, 1e16))
    session.set_noise(measurement_noise_cov=[1e-8, 1e8])
    for cov in (beside(BLOCK, 1e16), beside(1e6 * BLOCK, 1e-12)):
        with pytest.raises(ValueError, match="cov of a belief must be positive semidefinite"):
            filter_.predict(belief._replace(cov=cov), [0.0])
    filter_.predict(belief._replace(cov=np.diag([1e-12, 1.0, 1e16])), [0.0])


def test_an_estimator_s_covariance_beside_a_large_one_is_refused_too():
    checks = Checks("mine", 3, 1, True)
    with pytest.raises(ValueError, match="must be symmetric and positive semidefinite"):
        checks.output((np.zeros(3), beside(BLOCK, 1e12)), "step 1")
    assert checks.output((np.zeros(3), np.diag([1e-9, 1.0, 1e9])), "step 1").cov.shape == (3, 3)


@pytest.mark.parametrize(("n", "known"), [(2, False), (2, True), (6, False), (6, True)])
@pytest.mark.usefixtures("as_python")
def test_what_a_filter_itself_makes_of_a_belief_it_takes_again(n, known):
    """From a vague prior to sensors a million times better, in the plainest form of the update."""
    base = random_affine(n, n, 1)
    prior = np.full(n, 1e6)
    if known:
        prior[0] = 0.0
    model = base.replace(
        prior_cov=prior, process_noise_cov=np.zeros((n, n)), measurement_noise_cov=np.full(n, 1e-6)
    )
    for name in ("kf", "ukf"):
        filter_, belief = make_filter(name, model), None
        belief = filter_.init()
        for k in range(20):
            belief, _ = filter_.update(belief, np.full(n, 0.1 * k))
            belief = filter_.predict(belief, [0.0])


@pytest.mark.parametrize("dt", [1e-6, 1e-3, 1.0])
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_densities_of_a_q_are_those_it_was_made_of(dt, unit):
    a, units = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -0.3]]), np.array([unit, 1.0, 1.0 / unit])
    a, densities = a * units[:, None] / units, in_units(np.diag([0.0, 0.0, 2.0]), *units)
    found = densities_of(noise_of_densities(densities, a, dt), a, dt)
    np.testing.assert_allclose(found, densities, rtol=1e-9)


def test_a_variance_far_below_zero_is_refused_where_its_correlation_is_beyond_float64():
    filter_ = make_filter("ekf", plane_model(prior_cov=[1e-4] * len(plane_model().prior_mean)))
    belief = filter_.init((1, 2))
    with pytest.raises(ValueError, match="cov of a belief must be"):
        filter_.update(belief._replace(cov=np.full_like(belief.cov, -1e308)), np.zeros(filter_.model.m))
