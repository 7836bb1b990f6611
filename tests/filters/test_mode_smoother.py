"""The smoother of filters of several models: all sequences of modes, one model twice, models that never change."""

from itertools import product

import numpy as np
import pytest

from filters import ExtendedKalmanFilter, KalmanFilter, affine_model, make_filter, run, smooth, smooth_modes
from filters.rts import passes, relation_of
from filters.smoothers import condition_on_later, merged
from tests.filters.test_multiple_models import merged as mixture
from tests.filters.test_multiple_models import moving
from tests.filters.test_unequal_modes import moving as point
from tests.models import pendulum, simulated
from tests.oracles import each_close
from tests.slow import slow_but
from thruster_env.core.compiled import interpreted

MODELS = [moving(0.01), moving(4.0)]
TRANSITION, P = np.array([[0.9, 0.1], [0.2, 0.8]]), np.array([0.7, 0.3])
STEPS = 7


def imm(**numbers):
    given = {"modes": MODELS, "mode_filter": "kf", "transition": TRANSITION, "probabilities": P}
    return make_filter("imm", MODELS[0], **{**given, **numbers})


def drawn(count, steps, seed=0):
    """Modes (B, K + 1), states and positions of the two models in turns."""
    rng, a = np.random.default_rng(seed), MODELS[0].matrices()[0]
    modes, states = np.zeros((count, steps + 1), dtype=int), np.zeros((count, steps + 1, 2))
    for b in range(count):
        for k in range(steps + 1):
            modes[b, k] = rng.choice(2, p=TRANSITION[modes[b, k - 1]] if k else P)
            q = MODELS[modes[b, k]].process_noise_cov if k else MODELS[0].prior_cov
            states[b, k] = (a @ states[b, k - 1] if k else 0.0) + rng.multivariate_normal(np.zeros(2), q)
    return modes, states, states[:, :, :1] + rng.normal(size=(count, steps + 1, 1))


def by_all_sequences(z):
    """Smoothed means (K + 1, 2) and probabilities of the modes, from all 2^(K + 1) sequences of modes."""
    a, logs, means, sequences = MODELS[0].matrices()[0], [], [], np.array(list(product((0, 1), repeat=len(z))))
    for modes in sequences:
        x, p, level, filtered, predicted = np.zeros(2), MODELS[0].prior_cov, np.log(P[modes[0]]), [], []
        for k, value in enumerate(z[:, 0]):
            if k:
                x, p = a @ x, a @ p @ a.T + MODELS[modes[k]].process_noise_cov
                level += np.log(TRANSITION[modes[k - 1], modes[k]])
            predicted.append((x, p))
            s, gain = p[0, 0] + 1.0, p[:, 0] / (p[0, 0] + 1.0)
            level -= 0.5 * (np.log(s) + (value - x[0]) ** 2 / s)
            x, p = x + gain * (value - x[0]), p - np.outer(gain, gain) * s
            filtered.append((x, p))
        found = [x]
        for k in reversed(range(len(z) - 1)):
            x_k, p_k = filtered[k]
            gain = p_k @ a.T @ np.linalg.inv(predicted[k + 1][1])
            found.insert(0, x_k + gain @ (found[0] - predicted[k + 1][0]))
        logs.append(level)
        means.append(found)
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    probabilities = [[weights[sequences[:, k] == j].sum() for j in (0, 1)] for k in range(len(z))]
    return np.einsum("s,skn->kn", weights, means), np.array(probabilities)


@pytest.mark.usefixtures("as_python")
def test_it_is_near_to_what_all_sequences_of_modes_say():
    count, filter_ = 10, imm()
    _, _, z = drawn(count, STEPS)
    inputs = np.zeros((count, STEPS, 1))
    filtered, found = run(filter_, None, inputs, z), smooth_modes(filter_, None, inputs, z)
    exact = [by_all_sequences(one) for one in z]
    means, probabilities = (np.array(part) for part in zip(*exact, strict=True))
    before, after = (abs(one.means - means)[:, :-1].mean() for one in (filtered, found))
    assert after < 0.3 * before  # what remains is what the filter itself leaves out
    assert abs(found.probabilities - probabilities).mean() < 0.07
    each_close((found.means[:, -1], found.probabilities.sum(axis=-1)), (filtered.means[:, -1], 1.0), rtol=1e-12)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("kind, make", [(KalmanFilter, lambda: MODELS[1]), (ExtendedKalmanFilter, pendulum)])
def test_of_one_model_twice_it_is_the_smoother_of_that(kind, make):
    model = make()
    filter_ = make_filter("imm", model, modes=[model, model], mode_filter=kind.name, stay=0.8)
    inputs, z = simulated(model, 20, missing=0.2)
    found, expected = smooth(filter_, None, inputs, z), smooth(kind(model=model), None, inputs, z)
    np.testing.assert_allclose(found.means, expected.means, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(found.covs, expected.covs, rtol=1e-8, atol=1e-10)


@pytest.mark.usefixtures("as_python")
def test_of_models_that_never_change_it_is_the_mixture_of_their_smoothers():
    filter_ = make_filter("mmae", MODELS[0], modes=MODELS, mode_filter="kf")
    _, _, z = drawn(3, 15)
    inputs = np.zeros((3, 15, 1))
    found = smooth_modes(filter_, None, inputs, z)
    each = [smooth(KalmanFilter(model=model), None, inputs, z) for model in MODELS]
    mu = found.probabilities
    assert (mu == mu[:, -1:]).all()  # what is known at the end holds throughout
    expected = sum(mu[:, :, j, None] * one.means for j, one in enumerate(each))
    np.testing.assert_allclose(found.means, expected, rtol=1e-9, atol=1e-10)
    spread = [one.covs + np.einsum("bki,bkj->bkij", *[one.means - expected] * 2) for one in each]
    cov = sum(mu[:, :, j, None, None] * one for j, one in enumerate(spread))
    np.testing.assert_allclose(found.covs, cov, rtol=1e-8, atol=1e-10)


@pytest.mark.usefixtures("as_python")
def test_it_is_nearer_to_the_truth_knows_the_modes_better_and_is_not_too_sure():
    count, steps, filter_ = 25, 30, imm()
    modes, states, z = drawn(count, steps, seed=5)
    inputs = np.zeros((count, steps, 1))
    filtered, found = run(filter_, None, inputs, z), smooth_modes(filter_, None, inputs, z)
    errors = [np.mean((one.means - states)[:, :-1] ** 2, axis=(0, 1)) for one in (found, filtered)]
    assert (errors[0] < [0.7 * errors[1][0], 0.6 * errors[1][1]]).all()
    brier = []
    for at in (found.probabilities, mode_probabilities(filter_, z)):
        brier.append(np.mean((at[:, :, 1] - modes) ** 2))
    assert brier[0] < 0.9 * brier[1]
    off = found.means - states
    nees = np.einsum("bki,bki->bk", off, np.linalg.solve(found.covs, off[..., None])[..., 0]).mean(axis=1)
    assert 1.0 < nees.mean() < 2.0  # on the safe side: what parts the modes at k counts in those at k + 1, too


def mode_probabilities(filter_, z):
    """Of the filter, (B, K + 1, 2)."""
    found = []
    for run_z in z:
        belief, _ = filter_.update(filter_.init(), run_z[0])
        found.append([filter_.mode_probabilities(belief)])
        for value in run_z[1:]:
            belief, _ = filter_.update(filter_.predict(belief, [0.0]), value)
            found[-1].append(filter_.mode_probabilities(belief))
    return np.array(found)


def test_angles_of_a_mixture_are_merged_the_short_way_round():
    weights, means = np.array([[0.6, 0.4]]), np.array([[[3.1], [-3.1]]])
    mean, cov = merged(weights, means, np.full((1, 2, 1, 1), 0.01), (True,))
    apart = 2 * np.pi - 6.2
    np.testing.assert_allclose(mean, 3.1 + 0.4 * apart, rtol=1e-12)
    np.testing.assert_allclose(cov[0, 0, 0], 0.01 + 0.24 * apart**2, rtol=1e-9)


def test_a_lag_and_a_mode_without_a_smoother_are_refused():
    z, inputs = np.zeros((1, 5, 1)), np.zeros((1, 4, 1))
    with pytest.raises(ValueError, match="a filter of several models must be smoothed without a lag, but got 2"):
        smooth(imm(), None, inputs, z, lag=2)
    with pytest.raises(ValueError, match="a mode of a smoother needs a filter of kf, .*, but got 'fading'"):
        smooth(imm(mode_filter="fading"), None, inputs, z)


def test_the_smoother_of_models_that_stay_is_that_of_each_by_itself():
    """Pi = I: each model's own smoother, weighed by its posterior; the acceleration of the mode that has it."""
    whole, small, p = point("pva", 0.3), point("vp", 0.3), np.array([0.4, 0.6])
    filter_ = make_filter("mmae", whole, modes=[small, whole], mode_filter="kf", probabilities=p)
    z = np.random.default_rng(5).normal(0.0, 1.5, (1, 16, 1))
    keys, inputs, found, levels = np.array([[0, 0]]), np.zeros((1, 15, 1)), [], []
    with interpreted():
        for one in (small, whole):
            alone = make_filter("kf", one)
            found.append(smooth(alone, keys, inputs, z))
            levels.append(run(alone, keys, inputs, z).log_likelihoods.sum())
        both = smooth_modes(filter_, keys, inputs, z)
    mu = p * np.exp(levels) / (p @ np.exp(levels))
    assert 0.05 < mu[0] < 0.95
    np.testing.assert_allclose(both.probabilities[0], np.tile(mu, (16, 1)), rtol=1e-7)
    (vp, pva), (vp_cov, pva_cov) = [one.means[0] for one in found], [one.covs[0] for one in found]
    means, covs = np.tile(pva, (2, 1, 1)), np.tile(pva_cov, (2, 1, 1, 1))
    means[0, :, :2], covs[0, :, :2, 2], covs[0, :, 2, :2] = vp[:, ::-1], 0.0, 0.0
    covs[0, :, :2, :2] = vp_cov[:, ::-1, ::-1]
    for k in range(16):
        mean, cov = mixture(mu, means[:, k], covs[:, k])
        np.testing.assert_allclose(both.means[0, k], mean, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(both.covs[0, k], cov, rtol=1e-6, atol=1e-9)


def test_a_step_back_from_a_mode_of_fewer_states_tells_the_others_by_their_covariance():
    """x + G (later - A x_o), P + G (E - C) G', G = P_:o A' C^-1, C = A P_oo A' + Q, of own states o."""
    small = point("pv", 0.3)
    imm = make_filter("imm", point("pva", 0.3), modes=[small, point("pva", 0.3)], mode_filter="kf")
    mode, rng, u = imm.mode_filters[0], np.random.default_rng(7), np.zeros((1, 1))
    root, less = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    x, p, later, e = rng.normal(size=3), root @ root.T + np.eye(3), rng.normal(size=(2, 3)), 0.1 * less @ less.T
    step, found = passes(mode, relation_of(mode, "a test")), []
    for one in later:
        level, mean, cov = condition_on_later(mode, mode.init(), [0, 1], x[None], p[None], u, one[None], e[None])
        ends = np.stack([x, mean[0]])[None], np.stack([p, cov[0]])[None], np.zeros((1, 2), bool)
        found.append((level[0], *(it[0, 0] for it in step(ends, u[:, None], 1))))
    a = small.matrices()[0]
    c = a @ p[:2, :2] @ a.T + small.process_noise_cov
    gain, off = np.linalg.solve(c, a @ p[:2]).T, later[:, :2] - a @ x[:2]
    for (_, mean, cov), one in zip(found, off, strict=True):
        np.testing.assert_allclose(mean, x + gain @ one, rtol=1e-8)
        np.testing.assert_allclose(cov, p + gain @ (e[:2, :2] - c) @ gain.T, rtol=1e-8, atol=1e-9)
    first, second = (-0.5 * one @ np.linalg.solve(c, one) for one in off)
    assert found[1][0] - found[0][0] == pytest.approx(second - first, rel=1e-8)


@pytest.mark.parametrize("given", slow_but([None, {"a": (0.0, 1.0)}], [None]))
def test_later_measurements_help_modes_of_unequal_sizes(given):
    whole = point("pva", 0.1)
    filter_ = make_filter("imm", whole, modes=[point("pv", 1e-3), whole], mode_filter="kf", stay=0.9, absent=given)
    rng, a, x = np.random.default_rng(6), whole.matrices()[0], np.zeros((12, 61, 3))
    for k in range(60):
        x[:, k + 1] = x[:, k] @ a.T
        x[:, k + 1, 2] = 2.0 * (20 <= k < 35)
    data = np.array([[i, 0] for i in range(12)]), np.zeros((12, 60, 1)), x[:, :, :1] + rng.normal(size=(12, 61, 1))
    filtered_, smoothed = run(filter_, *data).means, smooth(filter_, *data).means
    before, after = (np.sqrt(np.mean((one - x) ** 2, axis=(0, 1))) for one in (filtered_, smoothed))
    assert (after < 0.75 * before).all(), (before, after)


@pytest.mark.usefixtures("as_python")
def test_a_mode_that_no_other_leads_to_was_on_all_the_time_however_improbable_it_was():
    noise = {"process_noise_cov": [1e-4], "measurement_noise_cov": [0.1], "prior_mean": [0.0], "prior_cov": [1e-4]}
    plain, shifted = (
        affine_model(a=[[1.0]], b=[[0.0]], c=[[1.0]], measurement_offset=[shift], **noise) for shift in (0.0, 10.0)
    )
    z = np.repeat([10.0, 0.0], [5, 12])[None, :, None]
    filter_ = make_filter("imm", plain, modes=[plain, shifted], transition=[[0.9, 0.1], [0.0, 1.0]])
    found = smooth_modes(filter_, None, np.zeros((1, 16, 1)), z)
    np.testing.assert_allclose(found.probabilities[0, :, 0], 1.0, rtol=1e-12)
