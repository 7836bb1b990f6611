"""Noise and sample times that are set: a filter does what one made for them would do, or refuses in one line."""

import copy
import pickle
from typing import NamedTuple

import numpy as np
import pytest

from filters import FILTERS, KalmanFilter, make_filter, run, smooth, torch
from filters.differentiated import Wanted
from filters.sensitivity import ModelSlopes, derivatives
from filters.smoothers import WithSmoother
from tests.filters.checks import refused
from tests.filters.test_session import cart
from tests.fuzz import unequal_steps
from tests.kalman_by_hand import LIKE_KALMAN, KalmanByHand, LinearModel, close, covariance_of, smoothed_by_hand
from tests.models import affine, plane_model, simulated, small
from tests.oracles import each_close
from tests.slow import slow_but
from thruster_env.logs.log import in_any_steps

pytestmark = pytest.mark.usefixtures("as_python")

STEPS = 6
LENGTHS = [0.1, 0.05, 0.2, 0.07, 0.1, 0.3]
FACTORS = [0.5, 1.0, 2.0, 1.0, 0.1, 1.0]
NUMBERS = {
    "fuzzy": {"low": [-5.0, -5.0], "high": [5.0, 5.0]},
    "inversion": {"reach": 10.0},  # which else follows from Q
    "low-pass": {"reach": 10.0},
}
# What filters refuse, and by which words: all others must take it.
REFUSED = {
    **{(name, what): "Q and R of the filter" for name in ("kf-steady", "imm", "mmae") for what in ("Q", "R")},
    **{(name, "R"): f"R of the filter '{name}' cannot vary" for name in ("vb", "sage-husa")},
    **{
        (name, "dt"): f"'{name}' has the A and B of one dt: 'ekf' is the Kalman filter at any dt"
        for name in ("kf", "kf-steady")
    },
    **{(name, "dt"): "set_dt needs a filter with one model" for name in ("imm", "mmae", "fuzzy")},
    **{(name, "factor"): "scale_process_noise needs a filter with one model" for name in ("imm", "mmae", "fuzzy")},
    ("kf-steady", "factor"): "Q and R of the filter 'kf-steady' cannot vary",
}


class Both(NamedTuple):
    """Constants of which either may be the sample time."""

    dt: float
    drag: float
    substep: float


def moving(q=(0.01, 0.01), r=(0.05, 0.05), dt=0.1):
    """The cart, with an operating point."""
    changes = {"process_noise_cov": q, "measurement_noise_cov": r}
    return cart(dt).replace(operating_state=[0.0, 0.0], operating_input=[0.0], **changes)


def made(name, model, **numbers):
    numbers = {**NUMBERS.get(name, {}), **numbers}
    return make_filter(name, model, **numbers) if numbers else small(name, model)


def drawn(seed=0, count=STEPS):
    """Inputs, measurements, and Q and R of each step."""
    rng = np.random.default_rng(seed)
    q = [covariance_of(rng, 2, 0.1) for _ in range(count)]
    r = [covariance_of(rng, 2, 0.5) for _ in range(count)]
    z = np.where(rng.random((count + 1, 2)) < 0.15, np.nan, rng.normal(size=(count + 1, 2)))
    return rng.normal(size=(count, 1)), z, q, r


@pytest.mark.parametrize("what", ["Q", "R", "dt", "factor"])
@pytest.mark.parametrize("name", FILTERS)
def test_what_is_set_acts_as_if_the_filter_were_made_with_it_or_is_refused(name, what):
    inputs, z, qs, rs = drawn()
    session = made(name, moving()).session()
    session.start((1, 2), z[0])
    belief = session.belief()

    def set_one(k):
        if what == "Q":
            session.set_noise(process_noise_cov=qs[k])
            return moving(q=qs[k])
        if what == "R":
            session.set_noise(measurement_noise_cov=rs[k])
            return moving(r=rs[k])
        if what == "dt":
            session.set_dt(LENGTHS[k])
            return moving(dt=LENGTHS[k])
        session.scale_process_noise(FACTORS[k])
        return moving(q=FACTORS[k] * 0.01 * np.eye(2))

    if (name, what) in REFUSED:
        refused(REFUSED[name, what], set_one, 0)
        session.step(inputs[0], z[1])  # and nothing has changed
        expected, _ = made(name, moving()).update(made(name, moving()).predict(belief, inputs[0]), z[1])
        np.testing.assert_array_equal(session.mean, expected.mean)
        return
    for k in range(STEPS):
        other = made(name, set_one(k))
        session.step(inputs[k], z[k + 1])
        belief, innovation = other.update(other.predict(belief, inputs[k]), z[k + 1])
        each_close((session.mean, session.cov), (belief.mean, belief.cov), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(session.innovation_cov, innovation.cov, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", FILTERS)
def test_single_calls_and_batches_refuse_what_sessions_refuse(name):
    filter_ = made(name, moving())
    for what, (call, many) in {
        "Q": ("predict", "process_noise_covs"),
        "R": ("update", "measurement_noise_covs"),
    }.items():
        argument = "process_noise_cov" if what == "Q" else "measurement_noise_cov"
        given = [0.0] if call == "predict" else [0.1, 0.2]
        uses = (
            lambda call=call, given=given, argument=argument: getattr(filter_, call)(
                filter_.init(), given, **{argument: np.eye(2)}
            ),
            lambda what=what, many=many: run(
                filter_,
                inputs=np.zeros((1, 2, 1)),
                measurements=np.zeros((1, 3, 2)),
                **{many: np.array([np.eye(2)] * (2 if what == "Q" else 3))},
            ),
        )
        for use in uses:
            if (name, what) in REFUSED:
                refused(REFUSED[name, what], use)
            else:
                use()


PATHS = (
    unequal_steps._session,
    unequal_steps._pure,
    unequal_steps._batch,
    unequal_steps._live,
    unequal_steps._log,
)


@pytest.mark.parametrize("kind", LIKE_KALMAN)
@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.__name__)
def test_on_a_linear_model_it_is_the_kalman_filter_with_the_dt_q_and_r_of_each_step(path, kind):
    rng = np.random.default_rng([3, len(kind)])
    path(rng, LinearModel(rng, 3, 2, 1, substeps=2 if path is unequal_steps._live else 1), kind, kind)


@pytest.mark.parametrize("kind", unequal_steps.SMOOTHED)
def test_a_smoother_takes_q_and_r_of_each_step(kind):
    rng = np.random.default_rng(4)
    unequal_steps._smoother(rng, LinearModel(rng, 3, 2, 1), kind, kind)


def test_a_smoother_of_members_takes_q_and_r_of_each_step():
    rng = np.random.default_rng(5)
    of = LinearModel(rng, 2, 1, 1)
    q, r = unequal_steps._noises(rng, of, 8)
    u, z = rng.normal(size=(1, 8, 1)), rng.normal(size=(1, 9, 1))
    noise = {"process_noise_covs": q, "measurement_noise_covs": r}
    found = smooth(make_filter("etkf", of.model(), ensemble_size=4000), None, u, z, **noise)
    x, P = smoothed_by_hand(of, u[0], z[0], q, r)
    deviations = np.sqrt(np.array([one.diagonal() for one in P]))
    assert (np.abs(found.means[0] - x) / deviations).max() < 0.15
    assert np.abs(found.covs[0] / P - 1.0).max() < 0.3


def test_smoothers_refuse_noise_that_their_filter_refuses():
    noise = {"process_noise_covs": np.array([np.eye(2)])}
    with pytest.raises(ValueError, match="Q and R of the filter 'imm' cannot vary"):
        smooth(make_filter("imm", plane_model()), None, np.zeros((1, 1, 1)), np.zeros((1, 2, 2)), **noise)
    with pytest.raises(ValueError, match="process_noise_covs must have shape"):
        smooth(make_filter("ekf", plane_model()), None, np.zeros((1, 2, 1)), np.zeros((1, 3, 2)), **noise)


def test_a_fixed_lag_smoother_beside_a_session_keeps_what_was_set_at_each_step():
    rng, lag = np.random.default_rng(6), 3
    of = LinearModel(rng, 3, 2, 1)
    session = WithSmoother(of.filter("ekf").session(), of.filter("ekf"), lag)
    z, u, q = rng.normal(size=(9, 2)), rng.normal(size=(8, 1)), [covariance_of(rng, 3) for _ in range(8)]
    session.start((0, 0), z[0])
    hand, steps = KalmanByHand(of), []
    hand.update(z[0], of.dt, of.r)
    for k in range(8):
        dt = float(of.dt * rng.uniform(0.2, 2.0))
        session.set_dt(dt)
        session.set_noise(process_noise_cov=q[k])
        session.step(u[k], z[k + 1])
        before = hand.x, hand.P
        hand.predict(u[k], dt, q[k])
        steps.append((before, of.motion(dt)[0], hand.x, hand.P))
        hand.update(z[k + 1], dt, of.r)
        x, P = hand.x, hand.P
        for (mean, cov), f, next_x, next_P in steps[-lag:][::-1]:
            gain = np.linalg.solve(next_P, f @ cov).T
            x, P = mean + gain @ (x - next_x), cov + gain @ (P - next_P) @ gain.T
        for found, expected in zip(session.smoothed(), (x, P), strict=True):
            close(found, expected, 1e-9)


def test_a_window_of_members_keeps_the_length_of_each_step():
    inputs, z, qs, _ = drawn(count=12)
    plain, window = (made("ienkf", moving(), ensemble_size=12, window=one).session() for one in (0, 3))
    for session in (plain, window):
        session.start((1, 2), z[0])
        for k in range(12):
            session.set_dt(LENGTHS[k % 6])
            session.set_noise(process_noise_cov=qs[k])
            session.step(inputs[k], z[k + 1])
    each_close((window.mean, window.cov), (plain.mean, plain.cov), rtol=1e-9)


def test_two_measurements_at_one_time_both_count_in_a_window():
    model, rng = plane_model(), np.random.default_rng(7)
    for horizon in (1, 2, 10):
        window, plain = make_filter("mhe", model, horizon=horizon, loss="quadratic"), make_filter("ekf", model)
        beliefs = [window.init(), plain.init()]
        for _ in range(5):
            for z in (rng.normal(size=2), [np.nan, np.nan], [rng.normal(), np.nan], rng.normal(size=2)):
                beliefs = [one.update(b, z)[0] for one, b in zip((window, plain), beliefs, strict=True)]
                close(beliefs[0].mean, beliefs[1].mean, 1e-9)
                close(beliefs[0].cov, beliefs[1].cov, 1e-9)
            beliefs = [one.predict(b, [0.3]) for one, b in zip((window, plain), beliefs, strict=True)]
        assert len(window.window(beliefs[0])) == min(horizon, 16)


@pytest.mark.parametrize("name", ["ekf", "mhe", "sage-husa", "enkf"])
def test_copies_and_pickles_of_a_session_keep_what_was_set(name):
    session = made(name, moving()).session()
    session.start((1, 2), [0.1, 0.2])
    session.set_dt(0.3)
    session.set_noise(process_noise_cov=[0.5, 0.2])
    session.step([1.0], [0.3, 0.1])
    copies = copy.deepcopy(session), pickle.loads(pickle.dumps(session))
    for one in (session, *copies):
        one.step([1.0], [0.4, 0.1])
    for one in copies:
        np.testing.assert_array_equal(one.mean, session.mean)
        one.clear()
        one.start((1, 2), [0.1, 0.2])
        one.step([1.0], [0.3, 0.1])
    first = made(name, moving()).session()
    first.start((1, 2), [0.1, 0.2])
    first.step([1.0], [0.3, 0.1])
    np.testing.assert_array_equal(copies[1].mean, first.mean)


@pytest.mark.parametrize("name", ["kf", "ekf", "ukf", "ckf"])
def test_a_smoother_does_not_mind_the_order_of_states_of_which_some_are_known_exactly(name):
    a, q, p, c = (
        np.array([[1.0, 0.0, 0.0], [0.3, 0.9, 0.1], [0.0, 0.0, 1.0]]),
        [0.0, 0.1, 0.0],
        [0.0, 1.0, 0.0],
        [0, 1, 0],
    )
    z, found = np.random.default_rng(8).normal(size=(1, 8, 1)), []
    for order in ([0, 1, 2], [1, 0, 2], [2, 0, 1], [2, 1, 0]):
        noise = {"q": np.array(q)[order], "r": [0.5]}
        prior = {"mean": np.array([1.0, 0.0, 0.5])[order], "cov": np.array(p)[order]}
        model = affine(
            a[np.ix_(order, order)], np.zeros((3, 0)), [np.array(c, dtype=float)[order]], **noise, **prior
        )
        smoothed = smooth(make_filter(name, model), measurements=z)
        found.append(smoothed.means[..., np.argsort(order)])
    for one in found[1:]:
        np.testing.assert_allclose(one, found[0], rtol=1e-7, atol=1e-9)


def test_filters_of_one_affine_model_refuse_steps_of_any_length():
    for name in ("kf", "kf-steady"):
        with pytest.raises(ValueError, match=f"must know steps of any length, but '{name}' does not: 'ekf' does"):
            make_filter(name, in_any_steps(moving()))
    assert not KalmanFilter.any_step


@pytest.mark.parametrize(
    ("name", "number", "parameter"),
    [
        ("kf-steady", "process_noise_cov", "gain"),
        ("kf-steady", "measurement_noise_cov", "gain"),
        ("kf-steady", "constants", "gain"),
        ("h-infinity", "prior_cov", "weights"),
    ],
)
def test_tensors_refuse_numbers_that_a_parameter_was_worked_out_from(name, number, parameter):
    model = plane_model()
    u, z = simulated(model, 3)
    tensors = torch(make_filter(name, model))
    value = getattr(tensors, number)
    for other in (1.5 * value, value.clone().requires_grad_()):
        with pytest.raises(ValueError, match=f"{number} of '{name}' on tensors must be the model's.*{parameter}"):
            tensors.replace(**{number: other}).run(u, z)
    expected = run(make_filter(name, model), None, u, z).means
    np.testing.assert_allclose(tensors.replace(**{number: value.clone()}).run(u, z).means, expected, rtol=1e-9)


def test_tensors_take_a_gain_of_ones_own_beside_another_q():
    model = plane_model()
    other = model.replace(process_noise_cov=2.0 * model.process_noise_cov)
    u, z = simulated(model, 5)
    gain = make_filter("kf-steady", other).gain
    tensors = torch(make_filter("kf-steady", model)).replace(process_noise_cov=other.process_noise_cov, gain=gain)
    np.testing.assert_allclose(tensors.run(u, z).means, run(make_filter("kf-steady", other), None, u, z).means)


def test_the_gradient_along_the_prior_has_the_weights_that_follow_from_it():
    model, rng = plane_model(), np.random.default_rng(9)
    u, z, slope = rng.normal(size=(1, 5, 1)), rng.normal(size=(1, 6, 2)), np.array([[[1.0, 0.0], [0.0, 0.5]]])
    wanted = Wanted(information=False, constants=False, tails=False)
    filter_ = make_filter("h-infinity", model)
    out, _ = derivatives(model, u, z, ModelSlopes.of(model, 1, prior_cov=slope), wanted, used=filter_)

    def level(step):
        moved = model.replace(prior_cov=model.prior_cov + step * slope[0])
        return run(make_filter("h-infinity", moved), None, u, z).log_likelihoods.sum()

    assert out[0, 0, 1] == pytest.approx((level(1e-5) - level(-1e-5)) / 2e-5, rel=1e-5)


def test_of_two_constants_that_may_be_the_sample_time_none_is_taken():
    model = moving().replace(constants=Both(0.1, 0.3, 0.05))
    for use in (lambda: make_filter("ekf", model).session().set_dt(0.2), lambda: make_filter("ekf", model).live()):
        refused("a model with one of the constants dt and substep, but got both", use)


OTHERS = {
    "process_noise_cov": np.array([[0.05, 0.01], [0.01, 0.02]]),
    "measurement_noise_cov": np.array([[0.2, 0.05], [0.05, 0.3]]),
    "prior_mean": np.array([0.3, -0.2]),
    "prior_cov": np.array([[2.0, 0.3], [0.3, 0.5]]),
}
WITHOUT_TENSORS = "mhe rhf pf apf rbpf gsf imm mmae fuzzy open-loop low-pass inversion".split()
ON_TENSORS = [name for name in FILTERS if name not in WITHOUT_TENSORS]


@pytest.mark.parametrize(
    "name", slow_but(ON_TENSORS, {"ekf", "kf-steady", "h-infinity", "vb", "sage-husa", "etkf"})
)
def test_tensors_with_other_numbers_are_the_filter_of_a_model_with_them_or_are_refused(name):
    inputs, z, *_ = drawn(count=3)
    tensors, follow = torch(made(name, moving())), made(name, moving()).follows_from
    for number, value in OTHERS.items():
        other = tensors.replace(**{number: value})
        if any(number in names for names in follow.values()):
            refused(f"{number} of '{name}' on tensors must be the model's", other.run, inputs[None], z[None])
            continue
        expected = run(made(name, moving().replace(**{number: value})), None, inputs[None], z[None])
        found = other.run(inputs[None], z[None])
        np.testing.assert_allclose(found.means, expected.means, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(found.log_likelihoods, expected.log_likelihoods, rtol=1e-9, atol=1e-10)
