"""Information, square-root and UD forms of kf, ekf and ukf: the same estimates, each with its own strength."""

import math
from fractions import Fraction
from functools import partial

import numpy as np
import pytest

import filters
from filters import ExtendedKalmanFilter, KalmanFilter, UnscentedKalmanFilter, affine_model, run, smooth
from tests.filters.checks import refused
from tests.filters.test_c import built, estimated
from tests.filters.test_differentiated import swing_if
from tests.filters.test_filter_paths import assert_compiled_as_python, assert_paths_agree
from tests.models import KEY, affine, pendulum, rescaled, simulated, varying_noise, wide_model
from tests.oracles import each_close
from tests.slow import slow_but
from thruster_env.core.compiled import interpreted

ROOTS = [
    partial(KalmanFilter, form="square-root"),
    partial(ExtendedKalmanFilter, form="square-root"),
    partial(UnscentedKalmanFilter, form="square-root"),
    partial(KalmanFilter, form="ud"),
    partial(ExtendedKalmanFilter, form="ud"),
    partial(UnscentedKalmanFilter, form="square-root", alpha=0.6, beta=0.36, kappa=1.0),
]
FORMS = [*ROOTS, partial(KalmanFilter, form="information")]


def plain(filter_):
    numbers = {name: getattr(filter_, name) for name in ("alpha", "beta", "kappa") if hasattr(filter_, name)}
    return type(filter_)(model=filter_.model, **numbers)


@pytest.mark.parametrize("kind", FORMS)
@pytest.mark.parametrize("make", [wide_model, pendulum, partial(pendulum, substeps=3)])
@pytest.mark.usefixtures("as_python")
def test_the_estimates_are_those_of_the_covariance_form(kind, make):
    model = make()
    if kind.func is KalmanFilter and make is not wide_model:
        model = model.replace(operating_state=[0.1, 0.0], operating_input=[0.0])
    filter_ = kind(model=model)
    inputs, z = simulated(model, 40, missing=0.2)
    found, expected = (run(it, None, inputs, z) for it in (filter_, plain(filter_)))
    each_close(found, expected, rtol=1e-10, atol=1e-11)
    for covs in (found.covs[0], found.innovation_covs[0]):
        assert (covs == covs.transpose(0, 2, 1)).all() and (np.linalg.eigvalsh(covs) > 0.0).all()
    each_close(*(smooth(it, None, inputs, z) for it in (filter_, plain(filter_))), rtol=1e-8, atol=1e-10)
    noise = varying_noise(model, 40)
    varied = [run(it, None, inputs, z, **noise) for it in (filter_, plain(filter_))]
    each_close(*varied, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("kind", slow_but(FORMS, [FORMS[1], FORMS[-1]]))
def test_compiled_batch_loop_session_and_python_agree(kind):
    filter_ = kind(model=wide_model())
    inputs, z = simulated(filter_.model, 20, missing=0.2)
    assert_compiled_as_python(filter_, np.array([KEY]), inputs, z)
    assert_paths_agree(filter_, KEY, inputs, z)


@pytest.mark.parametrize("form", ["information", "square-root", "ud"])
@pytest.mark.usefixtures("as_python")
def test_a_change_of_units_changes_no_estimate(form):
    units = np.array([1000.0, 0.01, 7.0])
    inputs, z = simulated(wide_model())
    models = wide_model(), rescaled(wide_model(), units, np.ones(2))
    before, after = (run(KalmanFilter(model=model, form=form), None, inputs, z) for model in models)
    each_close((after.means / units, after.covs / np.outer(units, units)), before[:2], rtol=1e-9, atol=1e-9)


@pytest.mark.usefixtures("as_python")
def test_root_forms_start_from_an_exact_state_and_the_information_form_refuses_it():
    model = wide_model(prior_cov=np.diag([1.0, 0.0, 0.0]))
    inputs, z = simulated(model)
    expected = run(KalmanFilter(model=model), None, inputs, z)
    for form in ("square-root", "ud"):
        each_close(run(KalmanFilter(model=model, form=form), None, inputs, z), expected, rtol=1e-10, atol=1e-10)
    refused("prior_cov must be positive definite", KalmanFilter, model=model, form="information")


def test_the_square_root_form_keeps_its_digits_where_covariances_lose_theirs():
    """Two nearly equal channels, almost without noise: P (2, 2) then has a condition of 1e18."""
    small = 1e-9
    slope = 1.0 + small
    known = {"q": [0.0, 0.0], "r": [small**2] * 2, "mean": [0.0, 0.0], "cov": [1.0, 1.0]}
    model = affine(np.eye(2), np.zeros((2, 1)), [[1.0, 1.0], [1.0, slope]], **known)
    filter_ = KalmanFilter(model=model, form="square-root")
    with interpreted():
        belief, _ = filter_.update(filter_.init(), [0.0, 0.0])
    root = belief.extras.reshape(2, 2)
    # Y = I + C' C / small^2 and its inverse, in fractions.
    e, weight = Fraction(slope), 1 / Fraction(small**2)
    y_00, y_01, y_11 = 1 + 2 * weight, (1 + e) * weight, 1 + (1 + e * e) * weight
    det = y_00 * y_11 - y_01 * y_01
    expected = math.sqrt(y_11 / det), -float(y_01 / det) / root[0, 0], math.sqrt(1 / y_11)  # 1e-9 of root[0, 0]
    np.testing.assert_allclose(root[[0, 1, 1], [0, 0, 1]], expected, rtol=1e-6)
    assert root[1, 1] ** 2 < 1e-17 * belief.cov[1, 1]  # of this the covariance has nothing left


def test_the_root_is_carried_in_the_belief():
    filter_ = KalmanFilter(model=wide_model(), form="square-root")
    with interpreted():
        belief = filter_.init()
        for _ in range(3):
            root = belief.extras.reshape(3, 3)
            assert (root == np.tril(root)).all()
            np.testing.assert_allclose(root @ root.T, belief.cov, rtol=1e-14, atol=1e-15)
            belief, _ = filter_.update(filter_.predict(belief, [1.0, 0.0]), [1.0, 2.0])


@pytest.mark.usefixtures("as_python")
def test_it_is_filterpy_s_square_root_filter():
    peer = pytest.importorskip("filterpy.kalman")
    model = wide_model(state_offset=[0.0, 0.0, 0.0], measurement_offset=[0.0, 0.0])
    inputs, z = simulated(model, 30)
    found = run(KalmanFilter(model=model, form="square-root"), None, inputs, z)
    theirs = peer.SquareRootKalmanFilter(dim_x=3, dim_z=2, dim_u=2)
    theirs.F, theirs.B, _, theirs.H, _ = model.matrices()
    theirs.x, theirs.P = model.prior_mean[:, None].copy(), model.prior_cov
    theirs.Q, theirs.R = model.process_noise_cov, model.measurement_noise_cov
    for k in range(31):
        if k:
            theirs.predict(inputs[0, k - 1][:, None])
        theirs.update(z[0, k][:, None])
        each_close((found.means[0, k], found.covs[0, k]), (theirs.x[:, 0], theirs.P), rtol=1e-10, atol=1e-10)


def test_an_unknown_form_is_refused():
    for kind in (ExtendedKalmanFilter, UnscentedKalmanFilter):
        refused("form must be one of covariance, square-root.* but got", kind, model=pendulum(), form="cholesky")
    for form in ("cholesky", None, 3):
        rule = "form must be .*covariance.*information.*square-root.* but got"
        refused(rule, KalmanFilter, model=wide_model(), form=form)
    rule = "beta of the square-root form must be at least"
    refused(rule, UnscentedKalmanFilter, model=pendulum(), form="square-root", beta=0.5)


@pytest.mark.usefixtures("as_python")
def test_a_model_that_cannot_be_traced_has_the_ud_form_too():
    model = pendulum(transition=swing_if)
    inputs, z = simulated(model, 30, missing=0.2)
    filters_ = ExtendedKalmanFilter(model=model, form="ud"), ExtendedKalmanFilter(model=model)
    found, expected = (run(one, None, inputs, z) for one in filters_)
    each_close(found, expected, rtol=1e-8, atol=1e-9)  # of central differences


def test_on_tensors_there_is_no_ud_form():
    pytest.importorskip("torch")
    rule = "a filter on tensors must have another form, such as 'square-root', but got"
    refused(rule, filters.torch, ExtendedKalmanFilter(model=pendulum(), form="ud"))


def two_alike(small):
    """Three states, of which two channels with the variance small^2 see nearly the same.

    With small^2 below half a unit in the last place S is singular, though R and the problem are not. Source:
    Grewal, Andrews (2015), Kalman Filtering, example 7.2, after Dyer, McReynolds (1969), "Extension of square-root
    filtering to include process noise".
    """
    return affine_model(
        a=np.eye(3),
        b=np.zeros((3, 0)),
        c=[[1.0, 1.0, 1.0], [1.0, 1.0, 1.0 + small]],
        process_noise_cov=[0.0] * 3,
        measurement_noise_cov=[small**2] * 2,
        prior_mean=[0.0] * 3,
        prior_cov=[1.0] * 3,
    )


@pytest.mark.parametrize("kind", ROOTS[:-1])
@pytest.mark.usefixtures("as_python")
def test_in_single_precision_roots_do_where_covariances_fail(kind, tmp_path):
    """In C, with floats, beside the same form in double precision, which loses nothing that shows here."""
    model = two_alike(2.0**-13)
    filter_ = kind(model=model)
    rng = np.random.default_rng(3)
    truth = rng.normal(size=3)
    z = truth @ model.matrices()[3].T + rng.normal(size=(8, 2)) * 2.0**-13
    exact = run(filter_, None, np.zeros((1, 7, 0)), z[None])
    errors = {}
    for one in (filter_, plain(filter_)):
        folder = tmp_path / one.form
        folder.mkdir()
        (x, p, *_), *_ = estimated(built(one, folder, single=True), model, np.zeros((7, 0)), z)
        deviations = np.sqrt(np.einsum("kii->ki", exact.covs[0]))
        off = (
            abs(x - exact.means[0]) / deviations,
            abs(p - exact.covs[0]) / np.einsum("ki,kj->kij", *[deviations] * 2),
        )
        errors[one.form] = float(max(off[0].max(), off[1].max()))
    assert errors[filter_.form] < 0.05 and not errors["covariance"] < 1.0
