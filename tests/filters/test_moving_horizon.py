"""Moving-horizon estimation: the Kalman filter of a linear model, of others the minimum of its cost."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from filters import MovingHorizonFilter, make_filter, run, smooth
from tests.filters.checks import refused
from tests.models import KEY, line_model, plane_model, simulated, state_space
from tests.oracles import each_close, kalman_filter

KEYS, CLOSE = np.array([KEY]), {"rtol": 1e-9, "atol": 1e-9}
Q, R = np.array([[0.01, 0.002], [0.002, 0.02]]), np.array([[0.04, 0.01], [0.01, 0.09]])
PRIOR, PRIOR_COV, K = np.array([0.5, 0.0]), np.diag([0.5, 0.3]), 2.0
BOUNDS = {0: (0.7, None), 1: (-0.3, 0.2)}


@pytest.fixture(autouse=True)
def _in_python(as_python):
    """Machine code is compared with Python in test_filter_paths."""


@pytest.mark.parametrize("changes", [{}, {"process_noise_cov": [0.1, 0.0], "prior_cov": [0.0, 0.0]}])
def test_of_a_linear_model_it_is_the_kalman_filter_at_any_horizon(changes):
    model = plane_model(**changes)
    inputs, measurements = simulated(model, 25)
    measurements[0, 4], measurements[0, 9, 0] = np.nan, np.nan
    means, covs, _ = kalman_filter(model, inputs[0], measurements[0])
    for horizon in (1, 2, 5, 50):
        filter_ = MovingHorizonFilter(model=model, horizon=horizon, loss="quadratic", iterations=1)
        found = run(filter_, KEYS, inputs, measurements)
        each_close((found.means[0], found.covs[0]), (means, covs), **CLOSE)
        expected = run(make_filter("ekf", model), KEYS, inputs, measurements)
        for part in ("innovations", "innovation_covs", "log_likelihoods"):
            np.testing.assert_allclose(getattr(found, part), getattr(expected, part), **CLOSE)


def stepped(filter_, inputs, measurements):
    belief, _ = filter_.update(filter_.init(), measurements[0])
    for u, z in zip(inputs, measurements[1:], strict=True):
        belief, _ = filter_.update(filter_.predict(belief, u), z)
    return belief


def test_its_window_is_the_smoother_s_and_its_last_state_the_filter_s():
    model = line_model()
    inputs, measurements = simulated(model, 12)
    smoothed = smooth(make_filter("ekf", model), KEYS, inputs, measurements).means[0]
    for horizon in (4, 20):
        filter_ = MovingHorizonFilter(model=model, horizon=horizon, loss="quadratic")
        window = filter_.window(stepped(filter_, inputs[0], measurements[0]))
        assert len(window) == min(horizon, 13)
        np.testing.assert_allclose(window, smoothed[-horizon:], **CLOSE)


# The cost, written naively, and its minimum by SciPy


def transition(x, u, c):
    """A damped pendulum under a moment."""
    return x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - np.sin(x[0]) - 0.2 * x[1] * abs(x[1]))


def observe(x, c):
    """Two channels, neither of them linear."""
    return x[0] + 0.1 * x[0] * x[0] * x[0], x[0] * x[1]


def curved_model(**changes):
    """The pendulum."""
    return state_space(transition, observe, q=Q, r=R, mean=PRIOR, cov=PRIOR_COV, inputs=1, **changes)


def curved_data():
    """Inputs (6, 1) and measurements (7, 2) of the pendulum, with an outlier and gaps."""
    rng = np.random.default_rng(4)
    x, inputs, measurements = np.array([0.8, 0.1]), rng.normal(size=(6, 1)), []
    for k in range(7):
        measurements.append(observe(x, ()) + rng.multivariate_normal([0, 0], R))
        if k < 6:
            x = np.array(transition(x, inputs[k], ())) + rng.multivariate_normal([0, 0], Q)
    measurements = np.array(measurements)
    measurements[2, 0] += 2.0
    measurements[4, 1] = measurements[5] = np.nan
    return inputs, measurements


def disturbances(states, inputs):
    """What moves the states beside the model, in standard deviations."""
    moved = [transition(x, u, ()) for x, u in zip(states, inputs, strict=False)]
    return states[1:] - np.array(moved).reshape(-1, 2)


def rho(square, channels, loss):
    if loss == "student":
        return (K**2 + channels) / 2 * math.log1p(square / K**2)
    return square / 2 if loss == "quadratic" or square < K**2 else K * math.sqrt(square) - K**2 / 2


def cost(states, inputs, measurements, loss, arrival=(PRIOR, PRIOR_COV)):
    """Minus the log of the density of states, but for a constant."""
    states, (mean, P) = states.reshape(-1, 2), arrival
    total = 0.5 * (states[0] - mean) @ np.linalg.solve(P, states[0] - mean)
    total += sum(0.5 * w @ np.linalg.solve(Q, w) for w in disturbances(states, inputs))
    for x, z in zip(states, measurements, strict=True):
        seen = ~np.isnan(z)
        v = (z - observe(x, ()))[seen]
        total += rho(v @ np.linalg.solve(R[np.ix_(seen, seen)], v), seen.sum(), loss) if seen.any() else 0.0
    return total


def least(start, *arguments, bounds=None, limit=None):
    """The states where the cost is least, near others."""
    inputs, deviation = arguments[0], np.sqrt(np.diag(Q))
    rooms = [] if limit is None else [-1.0, 1.0]

    def room(x, side):
        return (limit - side * disturbances(x.reshape(-1, 2), inputs) / deviation).ravel()

    held = [{"type": "ineq", "fun": room, "args": (side,)} for side in rooms]
    options = {"bounds": bounds, "constraints": held, "options": {"maxiter": 500, "ftol": 1e-15}}
    return minimize(cost, start.ravel(), arguments, method="SLSQP", **options).x.reshape(-1, 2)


@pytest.mark.parametrize(("loss", "limit"), [("quadratic", 0.7), ("huber", 0.5), ("student", 0.5)])
@pytest.mark.parametrize("bounded", [False, True])
def test_its_window_is_where_the_cost_is_least_within_the_bounds(loss, limit, bounded):
    inputs, measurements = curved_data()
    filter_ = MovingHorizonFilter(
        model=curved_model(bounds=BOUNDS if bounded else {}),
        horizon=10,
        iterations=30,
        loss=loss,
        threshold=K,
        disturbance_limit=limit if bounded else math.inf,
    )
    window = filter_.window(stepped(filter_, inputs, measurements))
    start = window + 0.01 * np.sin(np.arange(window.size)).reshape(window.shape)
    sides = [BOUNDS[i % 2] for i in range(window.size)] if bounded else None
    expected = least(start, inputs, measurements, loss, bounds=sides, limit=limit if bounded else None)
    np.testing.assert_allclose(window, expected, atol=1e-5)
    if bounded:  # some bounds of either kind hold, and none is passed
        share = abs(disturbances(window, inputs)) / np.sqrt(np.diag(Q))
        assert window[:, 0].min() >= 0.7 and window[:, 1].min() == -0.3
        assert share.max() == pytest.approx(limit, rel=1e-8)


@pytest.mark.parametrize("loss", ["quadratic", "huber", "student"])
def test_behind_its_arrival_cost_the_window_is_the_least_as_well(loss):
    inputs, measurements = curved_data()
    filter_ = MovingHorizonFilter(model=curved_model(), horizon=3, iterations=30, loss=loss, threshold=K)
    belief = stepped(filter_, inputs, measurements)
    arrival = belief.extras[1:3], belief.extras[3:7].reshape(2, 2)
    window = filter_.window(belief)
    expected = least(window + 0.01, inputs[-2:], measurements[-3:], loss, arrival)
    np.testing.assert_allclose(window, expected, atol=1e-5)


def slopes(function, x, *others):
    """Central differences, by columns."""
    moves = 1e-6 * np.eye(len(x))
    columns = [np.subtract(function(x + d, *others), function(x - d, *others)) / 2e-6 for d in moves]
    return np.array(columns).T


def test_the_arrival_cost_is_the_extended_filter_s_along_the_estimate():
    inputs, measurements = curved_data()
    filter_ = MovingHorizonFilter(model=curved_model(), horizon=3, iterations=30, loss="quadratic")
    belief = stepped(filter_, inputs[:2], measurements[:3])
    x, z = filter_.window(belief)[0], measurements[0]
    H, F = slopes(observe, x, ()), slopes(transition, x, inputs[0], ())
    P = np.linalg.inv(np.linalg.inv(PRIOR_COV) + H.T @ np.linalg.inv(R) @ H)
    updated = x + P @ (np.linalg.solve(PRIOR_COV, PRIOR - x) + H.T @ np.linalg.solve(R, z - observe(x, ())))
    later = filter_.predict(belief, inputs[2])
    np.testing.assert_allclose(later.extras[1:3], transition(x, inputs[0], ()) + F @ (updated - x), atol=1e-7)
    np.testing.assert_allclose(later.extras[3:7].reshape(2, 2), F @ P @ F.T + Q, atol=1e-8)


@pytest.mark.parametrize("bounded", [False, True])
def test_the_covariance_is_the_last_block_of_the_inverse_hessian_without_bounds(bounded):
    inputs, measurements = curved_data()
    model = curved_model(bounds=BOUNDS if bounded else {})
    filter_ = MovingHorizonFilter(model=model, horizon=10, iterations=30, loss="huber", threshold=K)
    belief = stepped(filter_, inputs, measurements)
    window = filter_.window(belief)
    count = len(window)
    hessian = np.zeros((2 * count, 2 * count))
    hessian[:2, :2] = np.linalg.inv(PRIOR_COV)
    for k, (x, z) in enumerate(zip(window, measurements, strict=True)):
        at = slice(2 * k, 2 * k + 2)
        seen = ~np.isnan(z)
        if seen.any():
            H, r = slopes(observe, x, ())[seen], R[np.ix_(seen, seen)]
            v = (z - observe(x, ()))[seen]
            weight = min(1.0, K / math.sqrt(v @ np.linalg.solve(r, v)))
            hessian[at, at] += weight * H.T @ np.linalg.solve(r, H)
        if k + 1 < count:
            J = np.zeros((2, 2 * count))
            J[:, at], J[:, 2 * k + 2 : 2 * k + 4] = -slopes(transition, x, inputs[k], ()), np.eye(2)
            hessian += J.T @ np.linalg.solve(Q, J)
    np.testing.assert_allclose(belief.cov, np.linalg.inv(hessian)[-2:, -2:], rtol=1e-6)


@pytest.mark.parametrize("loss", ["huber", "student"])
def test_of_functions_that_cannot_be_traced_it_is_the_same(loss):
    def decides(x, u, c):
        return transition(x, u, c) if int(x[0] < 1e9) else x

    inputs, measurements = curved_data()
    data = KEYS, inputs[None], measurements[None]
    models = curved_model().replace(transition=decides), curved_model()
    found, expected = (run(MovingHorizonFilter(model=one, horizon=3, loss=loss), *data) for one in models)
    each_close(found, expected, rtol=1e-6, atol=1e-8)


def test_with_a_horizon_of_one_it_is_the_iterated_filter():
    inputs, measurements = curved_data()
    data = KEYS, inputs[None], measurements[None]
    expected = run(make_filter("iekf", curved_model(), iterations=20), *data)
    filter_ = MovingHorizonFilter(model=curved_model(), horizon=1, iterations=20, loss="quadratic")
    each_close(run(filter_, *data), expected, rtol=1e-7, atol=1e-9)


def reactor(**changes):
    """2 A -> B in a batch, of whose partial pressures the sum is measured; the reaction is solved exactly."""

    def react(x, u, c):
        a = x[0] / (1.0 + 0.032 * x[0])
        return a, x[1] + 0.5 * (x[0] - a)

    prior = {"mean": [0.1, 4.5], "cov": [36.0, 36.0]}
    return state_space(react, lambda x, c: (x[0] + x[1],), q=[1e-6, 1e-6], r=[0.01], **prior, inputs=0, **changes)


def test_in_a_batch_reactor_it_keeps_a_pressure_positive_that_the_ekf_takes_below_zero():
    """The example of Haseltine and Rawlings (2005), Industrial & Engineering Chemistry Research 44(8)."""
    rng, x, states = np.random.default_rng(0), np.array([3.0, 1.0]), []
    model = reactor(bounds={0: (0.0, None), 1: (0.0, None)})
    for _ in range(41):
        states.append(x)
        x = np.array(model.transition(tuple(x), (), ())) + 0.001 * rng.normal(size=2)
    z = np.sum(states, axis=1)[None, :, None] + 0.1 * rng.normal(size=(1, 41, 1))
    data = KEYS, np.zeros((1, 40, 0)), z
    wrong = run(make_filter("ekf", reactor()), *data).means[0]
    found = run(MovingHorizonFilter(model=model, horizon=15), *data)
    assert wrong[:, 0].min() < -1.0 and abs(wrong[-1] - states[-1]).max() > 1.0
    assert (found.means >= 0.0).all()
    assert abs(found.means[0, -1] - states[-1]).max() < 0.1


@pytest.mark.parametrize("loss", ["quadratic", "huber", "student"])
def test_its_window_is_where_the_cost_is_least_with_the_noise_of_each_step(loss):
    """The slope of the cost, each step with Q and R of its own and one step with two measurements, is zero."""
    inputs, measurements = curved_data()
    rng = np.random.default_rng(5)
    qs, rs = ([factor * one for factor in rng.uniform(0.2, 4.0, 8)] for one in (Q, R))
    filter_ = MovingHorizonFilter(model=curved_model(), horizon=20, iterations=50, loss=loss, threshold=K)
    belief, _ = filter_.update(filter_.init(), measurements[0], measurement_noise_cov=rs[0])
    second = np.array([1.1, 0.4])
    belief, _ = filter_.update(belief, second, measurement_noise_cov=rs[7])
    for k, (u, z) in enumerate(zip(inputs, measurements[1:], strict=True)):
        belief = filter_.predict(belief, u, process_noise_cov=qs[k])
        belief, _ = filter_.update(belief, z, measurement_noise_cov=rs[k + 1])
    window = filter_.window(belief)
    np.testing.assert_allclose(window[0], window[1], rtol=1e-9)  # one state, twice

    def of_one(x, z, r):
        seen = ~np.isnan(z)
        v = (z - observe(x, ()))[seen]
        return rho(v @ np.linalg.solve(r[np.ix_(seen, seen)], v), seen.sum(), loss) if seen.any() else 0.0

    def total(states):
        states = states.reshape(-1, 2)
        found = 0.5 * (states[0] - PRIOR) @ np.linalg.solve(PRIOR_COV, states[0] - PRIOR) + of_one(
            states[0], second, rs[7]
        )
        found += sum(
            0.5 * w @ np.linalg.solve(q, w) for w, q in zip(disturbances(states, inputs), qs, strict=False)
        )
        return found + sum(of_one(x, z, r) for x, z, r in zip(states, measurements, rs, strict=False))

    at = window[1:].ravel()
    slope = [(total(at + step) - total(at - step)) / 2e-5 for step in 1e-5 * np.eye(len(at))]
    np.testing.assert_allclose(slope, 0.0, atol=2e-3)


def test_a_window_is_no_mode_of_a_filter_that_mixes_estimates():
    rule = "'imm', which mixes estimates, must keep no window of steps, but got 'mhe'"
    refused(rule, make_filter, "imm", line_model(), mode_filter="mhe")
    modes, (inputs, measurements) = [{}, {}], simulated(line_model(), 6)
    found = run(make_filter("mmae", line_model(), modes=modes, mode_filter="mhe"), KEYS, inputs, measurements)
    expected = run(make_filter("mhe", line_model()), KEYS, inputs, measurements)
    np.testing.assert_allclose(found.means, expected.means, rtol=1e-9)


@pytest.mark.parametrize("loss", ["quadratic", "huber", "student"])
def test_sensors_that_are_read_one_after_the_other_share_a_step(loss):
    """With a diagonal R the window is that of both at once, and as long."""
    inputs, measurements = curved_data()
    model = curved_model().replace(measurement_noise_cov=np.diag(R))
    filter_ = MovingHorizonFilter(model=model, horizon=4, iterations=40, loss=loss, threshold=K)
    both = one_by_one = filter_.init()
    for k, z in enumerate(measurements):
        if k:
            both, one_by_one = (filter_.predict(one, inputs[k - 1]) for one in (both, one_by_one))
        both, _ = filter_.update(both, z)
        for i in (1, 0):
            alone = np.where(np.arange(2) == i, z, np.nan)
            one_by_one, _ = filter_.update(one_by_one, alone)
        assert len(filter_.window(one_by_one)) == min(k + 1, 4)
    np.testing.assert_allclose(filter_.window(one_by_one), filter_.window(both), rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(one_by_one.cov, both.cov, rtol=1e-6)
