"""Square-root and UD forms of kf, ekf and ukf: the same estimates, in float64 and where single precision fails."""

from functools import partial

import numpy as np
import pytest

import filters
from filters import ExtendedKalmanFilter, KalmanFilter, UnscentedKalmanFilter, affine_model, run, smooth
from tests.filters.test_c import built, estimated
from tests.filters.test_differentiated import swing_if
from tests.models import KEY, pendulum, simulated, wide_model
from tests.slow import slow_but

FORMS = [
    partial(KalmanFilter, form="square-root"),
    partial(ExtendedKalmanFilter, form="square-root"),
    partial(UnscentedKalmanFilter, form="square-root"),
    partial(KalmanFilter, form="ud"),
    partial(ExtendedKalmanFilter, form="ud"),
    partial(UnscentedKalmanFilter, form="square-root", alpha=0.6, beta=0.36, kappa=1.0),
]


def plain(filter_):
    """The same filter in the covariance form."""
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
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-12)
    for covs in (found.covs[0], found.innovation_covs[0]):
        assert (covs == covs.transpose(0, 2, 1)).all() and (np.linalg.eigvalsh(covs) > 0.0).all()
    smoothed = [smooth(it, None, inputs, z).means for it in (filter_, plain(filter_))]
    np.testing.assert_allclose(*smoothed, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("kind", slow_but(FORMS[1:-1], FORMS[1:2]))
def test_compiled_batch_session_and_python_agree(kind, request):
    model = wide_model() if kind.func is KalmanFilter else pendulum()
    filter_ = kind(model=model)
    inputs, z = simulated(model, 20, missing=0.2)
    compiled = run(filter_, np.array([KEY]), inputs, z)
    session = filter_.session()
    session.start(KEY, z[0, 0])
    for k in range(20):
        session.step(inputs[0, k], z[0, k + 1])
        np.testing.assert_allclose(session.mean, compiled.means[0, k + 1], rtol=1e-9, atol=1e-11)
        np.testing.assert_allclose(session.cov, compiled.covs[0, k + 1], rtol=1e-9, atol=1e-11)
    request.getfixturevalue("as_python")
    slow = run(filter_, np.array([KEY]), inputs, z)
    np.testing.assert_allclose(slow.means, compiled.means, rtol=1e-8, atol=1e-10)  # of central differences


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
        np.testing.assert_allclose(found.means[0, k], theirs.x[:, 0], rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(found.covs[0, k], theirs.P, rtol=1e-10, atol=1e-10)


@pytest.mark.usefixtures("as_python")
def test_an_unknown_form_is_refused():
    for kind in (ExtendedKalmanFilter, UnscentedKalmanFilter):
        with pytest.raises(ValueError, match="form must be one of covariance, square-root"):
            kind(model=pendulum(), form="cholesky")
    with pytest.raises(ValueError, match="beta of the square-root form must be at least"):
        UnscentedKalmanFilter(model=pendulum(), form="square-root", beta=0.5)


@pytest.mark.usefixtures("as_python")
def test_a_model_that_cannot_be_traced_has_the_ud_form_too():
    model = pendulum(transition=swing_if)
    inputs, z = simulated(model, 30, missing=0.2)
    filters_ = ExtendedKalmanFilter(model=model, form="ud"), ExtendedKalmanFilter(model=model)
    found, expected = (run(one, None, inputs, z) for one in filters_)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-9)  # of central differences


def test_on_tensors_there_is_no_ud_form():
    pytest.importorskip("torch")
    with pytest.raises(
        ValueError, match="a filter on tensors must have another form, such as 'square-root', but got"
    ):
        filters.torch(ExtendedKalmanFilter(model=pendulum(), form="ud"))


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


@pytest.mark.parametrize("kind", FORMS[:-1])
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
