"""Filters that learn R or weigh outliers: their estimates, against the naive recursions and the truth."""

import math

import numpy as np
import pytest

from filters import (
    ExtendedKalmanFilter,
    RobustExtendedKalmanFilter,
    SageHusaFilter,
    VariationalBayesFilter,
    run,
    thruster_model,
)
from filters.adaptive import bounded_step
from filters.engine.session import Session
from tests.models import plane_model, simulated
from tests.oracles import each_close, kalman_update
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate

KEY = (1, 2)
adaptive = pytest.mark.parametrize("kind", [SageHusaFilter, VariationalBayesFilter])


def noise_moment(p, innovation, h, r):
    """E[v v' | z] from the joint Gaussian of v and z."""
    s = h @ p @ h.T + r
    mean = r @ np.linalg.solve(s, innovation)
    return np.outer(mean, mean) + r - r @ np.linalg.solve(s, r)


@pytest.mark.parametrize("measured", [[2.0, 1.0], [200.0, 400.0]])
def test_sage_husa_is_the_textbook_recursion_with_bounded_steps(measured):
    model = plane_model()
    a, b, offset, h, shift = model.matrices()
    filter_ = SageHusaFilter(model=model, forgetting_factor=0.9, process_forgetting_factor=0.8)
    inputs, measurements = simulated(plane_model(measurement_noise_cov=measured), 30, level=1.0)
    x, p, q, r = model.prior_mean, model.prior_cov, model.process_noise_cov, model.measurement_noise_cov

    def length(d, old, less):
        return min(d, 0.5 / np.trace(np.linalg.solve(old, less)))

    with interpreted():
        belief = filter_.init(KEY)
        for k, z in enumerate(measurements[0]):
            if k > 0:
                belief = filter_.predict(belief, inputs[0, k - 1])
                moved = a @ p @ a.T
                x, p = a @ x + b @ inputs[0, k - 1] + offset, moved + q
            innovation = z - h @ x - shift
            before, old_p = x, p
            x, p, s = kalman_update(x, p, innovation, h, r)
            d = length(0.1, r, s)
            r = (1 - d) * r + d * (np.outer(innovation, innovation) - h @ old_p @ h.T)
            if k > 0:
                d = length(0.2, q, old_p - p)
                q = (1 - d) * q + d * (np.outer(x - before, x - before) + p - moved)
            belief, _ = filter_.update(belief, z)
            each_close((belief.mean, belief.cov), (x, p), rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(filter_.estimated_noise(belief), r, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(filter_.estimated_process_noise(belief), q, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_a_bounded_step_leaves_at_least_half(seed):
    rng = np.random.default_rng(seed)
    old, more, less = (part @ part.T for part in rng.normal(size=(3, 3, 3)) * [[[1.0]], [[0.0]], [[30.0]]])
    new = bounded_step(old, more, less, 0.9)
    assert np.linalg.eigvalsh(new - 0.5 * old)[0] > -1e-12
    assert not np.allclose(new, old)


def test_a_step_of_a_singular_matrix_is_none():
    old, less = np.diag([1.0, 0.0]), np.eye(2)
    np.testing.assert_array_equal(bounded_step(old, less, less, 0.1), old)


def test_variational_bayes_is_the_naive_recursion():
    model = plane_model()
    a, b, offset, h, shift = model.matrices()
    rho, weight = 0.95, 8.0
    filter_ = VariationalBayesFilter(model=model, forgetting_factor=rho, prior_weight=weight, iterations=4)
    inputs, measurements = simulated(plane_model(measurement_noise_cov=[2.0, 1.0]), 30, level=1.0)
    x, p, q = model.prior_mean, model.prior_cov, model.process_noise_cov
    scale = weight * model.measurement_noise_cov
    with interpreted():
        belief = filter_.init(KEY)
        for k, z in enumerate(measurements[0]):
            if k > 0:
                belief = filter_.predict(belief, inputs[0, k - 1])
                x, p = a @ x + b @ inputs[0, k - 1] + offset, a @ p @ a.T + q
            r, expected = scale / weight, z - h @ x - shift
            s = h @ p @ h.T + r
            belief, innovation = filter_.update(belief, z)
            np.testing.assert_allclose(innovation.cov, s, rtol=1e-9)
            scale, weight = rho * scale, rho * weight + 1.0
            for _ in range(4):
                new_scale = scale + noise_moment(p, expected, h, r)
                r = new_scale / weight
            scale = new_scale
            x, p, _ = kalman_update(x, p, expected, h, r)
            each_close((belief.mean, belief.cov), (x, p), rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(filter_.estimated_noise(belief), r, rtol=1e-9)
            assert belief.extras[-1] == pytest.approx(weight)


def test_for_one_channel_it_is_the_inverse_gamma_recursion_of_sarkka_and_nummenmaa():
    model = plane_model(c=[[1.0, 0.4]], measurement_offset=[0.0], measurement_noise_cov=[0.5])
    filter_ = VariationalBayesFilter(model=model, forgetting_factor=0.9, prior_weight=6.0, iterations=30)
    a, b, offset, h, _ = model.matrices()
    x, p, alpha, beta = model.prior_mean, model.prior_cov, 3.0, 3.0 * 0.5
    inputs, measurements = simulated(model, 20, level=1.0)
    with interpreted():
        belief = filter_.init(KEY)
        for k, z in enumerate(measurements[0]):
            if k > 0:
                belief = filter_.predict(belief, inputs[0, k - 1])
                x, p = a @ x + b @ inputs[0, k - 1] + offset, a @ p @ a.T + model.process_noise_cov
            belief, _ = filter_.update(belief, z)
            alpha, prior_beta = 0.9 * alpha + 0.5, 0.9 * beta
            beta = prior_beta
            for _ in range(200):  # their algorithm, to its fixed point
                new_x, new_p, _ = kalman_update(x, p, z - h @ x, h, np.array([[beta / alpha]]))
                beta = prior_beta + 0.5 * float((z - h @ new_x)[0] ** 2 + (h @ new_p @ h.T)[0, 0])
            x, p = new_x, new_p
            assert filter_.estimated_noise(belief)[0, 0] == pytest.approx(beta / alpha, rel=1e-6)
            np.testing.assert_allclose(belief.mean, x, rtol=1e-6, atol=1e-8)


def many_long(model):
    """Inputs and measurements of 30 runs of 2000 steps."""
    return simulated(model, 2000, count=30, seed=7, level=1.0, compiled=True)


def last_beliefs(filter_, inputs, measurements):
    session = Session(filter_)
    for u, z in zip(inputs, measurements, strict=True):
        session.start(KEY, z[0])
        for k in range(len(u)):
            session.step(u[k], z[k + 1])
        yield session.belief()


@adaptive
def test_it_finds_the_true_noise_within_2000_steps(kind):
    actual = np.array([[2.0, 0.6], [0.6, 1.0]])
    inputs, measurements = many_long(plane_model(measurement_noise_cov=actual))
    filter_ = kind(model=plane_model(), forgetting_factor=0.995)
    found = np.array([filter_.estimated_noise(last) for last in last_beliefs(filter_, inputs, measurements)])
    spread = found.std(axis=0, ddof=1)
    # Each estimate averages some 400 measurements, and so is off by several per cent.
    assert (spread < 0.15 * np.sqrt(np.outer(np.diag(actual), np.diag(actual)))).all()
    # The mean of 30 runs covers the truth at 99.9 %.
    assert (np.abs(found.mean(axis=0) - actual) < 3.29 * spread / math.sqrt(30)).all()
    assert (np.linalg.eigvalsh(found) > 0).all()


def test_sage_husa_finds_q_where_both_channels_tell_of_it():
    actual = np.array([[1.2, 0.3], [0.3, 0.8]])
    inputs, measurements = many_long(plane_model(process_noise_cov=actual))
    filter_ = SageHusaFilter(model=plane_model(), forgetting_factor=1.0, process_forgetting_factor=0.995)
    found = [filter_.estimated_process_noise(last) for last in last_beliefs(filter_, inputs, measurements)]
    spread = np.std(found, axis=0, ddof=1)
    assert (spread < 0.25).all()
    assert (np.abs(np.mean(found, axis=0) - actual) < 3.29 * spread / math.sqrt(30)).all()


@adaptive
def test_what_is_missing_teaches_nothing(kind):
    model = plane_model()
    filter_ = kind(model=model)
    with interpreted():
        belief, _ = filter_.update(filter_.init(KEY), [2.0, np.nan])
        learnt = filter_.estimated_noise(belief)
        for _ in range(50):
            belief, _ = filter_.update(filter_.predict(belief, [0.0]), [np.nan, np.nan])
    np.testing.assert_allclose(filter_.estimated_noise(belief), learnt, rtol=1e-12)
    assert (np.linalg.eigvalsh(learnt) > 0).all()


def test_an_estimate_of_the_noise_is_a_copy():
    filter_ = SageHusaFilter(model=plane_model())
    with interpreted():
        belief = filter_.init(KEY)
    for estimate in (filter_.estimated_noise(belief), filter_.estimated_process_noise(belief)):
        estimate[:] = np.nan
    assert np.isfinite(belief.extras).all()


def with_outliers(model, count):
    """Inputs, states and measurements of the thruster, one measurement in twenty off by 10 N."""
    rng = np.random.default_rng(3)
    inputs = np.repeat(rng.uniform(-12.0, 12.0, size=(count, 10, 1)), 25, axis=1)
    drawn = simulate.simulate(model, episode_keys(range(count)), inputs)
    hit = rng.random(drawn.measurements.shape) < 0.05
    off = np.where(hit, rng.normal(size=hit.shape) * 10.0, 0.0)
    return inputs, drawn.states, drawn.measurements, off


def test_on_outliers_the_robust_filter_beats_the_extended_one_and_costs_little_without():
    model = thruster_model(process_noise_cov=[1.0, 4e-4], measurement_noise_cov=0.25)
    inputs, states, z, off = with_outliers(model, 40)

    def squares(kind, measurements):
        estimates = run(kind(model=model), np.zeros((40, 2)), inputs, measurements)
        return ((estimates.means - states)[:, 50:] ** 2).mean(axis=1)

    plain, robust = (squares(kind, z + off) for kind in (ExtendedKalmanFilter, RobustExtendedKalmanFilter))
    gain = 0.5 * plain - robust  # in both states, the error's power is less than half
    assert (gain.mean(axis=0) > 1.96 * gain.std(axis=0, ddof=1) / math.sqrt(40)).all()
    clean, of_robust = (
        squares(kind, z).mean(axis=0) for kind in (ExtendedKalmanFilter, RobustExtendedKalmanFilter)
    )
    assert (of_robust < 1.05 * clean).all()


def test_the_robust_filter_says_which_measurement_was_an_outlier():
    model = thruster_model()
    filter_ = RobustExtendedKalmanFilter(model=model)
    with interpreted():
        belief = filter_.predict(filter_.init(KEY), [6.0])
        z = np.array(model.observe(tuple(belief.mean), model.constants))
        weights = [filter_.update(belief, z + off)[0].extras[0] for off in (0.0, 1.0, 20.0)]
        missing, _ = filter_.update(belief, [np.nan])
    assert weights[0] > 1.0 > weights[1] > 10 * weights[2] > 0.0
    assert missing.extras[0] == 1.0


def test_the_robust_filter_is_the_naive_fixed_point():
    model, freedom = plane_model(), 3.0
    _, _, _, h, shift = model.matrices()
    filter_ = RobustExtendedKalmanFilter(model=model, degrees_of_freedom=freedom, iterations=7)
    r, z = model.measurement_noise_cov, np.array([6.0, 3.0])
    with interpreted():
        belief = filter_.init(KEY)
        updated, innovation = filter_.update(belief, z)
    expected, weight = z - h @ belief.mean - shift, 1.0
    for _ in range(7):
        moment = noise_moment(belief.cov, expected, h, r / weight)
        weight = (freedom + 2) / (freedom + np.trace(np.linalg.solve(r, moment)))
    x, p, _ = kalman_update(belief.mean, belief.cov, expected, h, r / weight)
    assert updated.extras[0] == pytest.approx(weight, rel=1e-10)
    np.testing.assert_allclose(updated.mean, x, rtol=1e-10)
    np.testing.assert_allclose(updated.cov, p, rtol=1e-9)
    np.testing.assert_allclose(
        innovation.cov, h @ belief.cov @ h.T + r, rtol=1e-12
    )  # the NIS is to tell an outlier
