"""The Rao-Blackwellised particle filter against its source's equations, the Kalman filter and plain particles."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import RaoBlackwellisedParticleFilter, affine_model, make_filter, run
from tests.models import KEY, line_model, plane_model, simulated, state_space
from tests.oracles import assert_normal, each_close, normals
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS, uniform_block
from tuning.experiments import mixed_linear

Q = np.array([[0.04, 0.01, -0.01], [0.01, 0.03, 0.008], [-0.01, 0.008, 0.02]])  # of s, a, b: s and the others too
R = np.array([[0.1, 0.02], [0.02, 0.05]])


def move(x, u, c):
    """Affine in a and b where s is known: all of Schon's matrices depend on s."""
    s, a, b = x
    turn = 0.3 * np.sin(s)
    return (np.arctan(s) + (0.5 + 0.2 * s) * a - 0.1 * b + u[0], 0.9 * a + turn * b, 0.95 * b - turn * a + 0.1 * s)


def see(x, c):
    return (0.1 * x[0] * abs(x[0]) + 0.3 * x[2], x[1] - np.cos(x[0]) * x[2])


def see_by_branches(x, c):
    """The same, in a form that cannot be traced."""
    return (0.1 * x[0] * (x[0] if int(x[0] > 0.0) else -x[0]) + 0.3 * x[2], x[1] - np.cos(x[0]) * x[2])


def mixed_model(observe=see):
    prior = {"mean": [0.3, 0.1, -0.2], "cov": [[0.5, 0.1, 0.0], [0.1, 0.2, 0.05], [0.0, 0.05, 0.1]]}
    return state_space(move, observe, q=Q, r=R, **prior, inputs=1)


def parts(s):
    """The textbook's f and A of s' and of (a, b)', and h and C, at a sampled s."""
    turn = 0.3 * np.sin(s)
    of_s = np.arctan(s), np.array([0.5 + 0.2 * s, -0.1])
    of_rest = np.array([0.0, 0.1 * s]), np.array([[0.9, turn], [-turn, 0.95]])
    return of_s, of_rest, (np.array([0.1 * s * abs(s), 0.0]), np.array([[0.0, 0.3], [1.0, -np.cos(s)]]))


class Textbook:
    """Schon, Gustafsson, Nordlund (2005), algorithm 1 with the equations (22)-(25), a particle after the other."""

    def __init__(self, model, size):
        self.size, cov, e = size, model.prior_cov, normals(FILTER_PRIOR, 0, 1, size)[0]
        gain = cov[1:, 0] / cov[0, 0]
        self.s = model.prior_mean[0] + math.sqrt(cov[0, 0]) * e
        self.means = [model.prior_mean[1:] + gain * (s - model.prior_mean[0]) for s in self.s]
        self.covs = [cov[1:, 1:] - np.outer(gain, cov[0, 1:])] * size
        self.w = np.full(size, 1.0 / size)

    def predict(self, u, step):
        if 1.0 / (self.w**2).sum() < 0.5 * self.size:
            first, *_ = uniform_block(0, step - 1, FILTER_MEASUREMENT, *KEY)
            chosen = np.searchsorted(np.cumsum(self.w), (first + np.arange(self.size)) / self.size)
            self.s, self.w = self.s[chosen], np.full(self.size, 1.0 / self.size)
            self.means, self.covs = [self.means[i] for i in chosen], [self.covs[i] for i in chosen]
        cross = Q[1:, 0] / Q[0, 0]
        for j, e in enumerate(normals(FILTER_PROCESS, step, 1, self.size)[0]):
            (f_s, a_s), (f, a), _ = parts(self.s[j])
            mean, p = self.means[j], self.covs[j]
            n = a_s @ p @ a_s + Q[0, 0]
            seen = a_s @ mean + math.sqrt(n) * e  # s' less what is known of it
            decorrelated = a - np.outer(cross, a_s)
            gain = decorrelated @ p @ a_s / n
            self.means[j] = decorrelated @ mean + cross * seen + f + gain * (seen - a_s @ mean)
            rest = Q[1:, 1:] - np.outer(cross, Q[0, 1:])
            self.covs[j] = decorrelated @ p @ decorrelated.T + rest - n * np.outer(gain, gain)
            self.s[j] = f_s + u + seen

    def update(self, z):
        levels, expected, seen_covs = [], [], []
        for j, s in enumerate(self.s):
            _, _, (h, c) = parts(s)
            p, y = self.covs[j], h + c @ self.means[j]
            cov = c @ p @ c.T + R
            there = ~np.isnan(z)
            k = p @ c[there].T @ np.linalg.inv(cov[np.ix_(there, there)])
            levels.append(multivariate_normal.pdf(z[there], y[there], cov[np.ix_(there, there)]))
            expected.append(y), seen_covs.append(cov)
            self.means[j] = self.means[j] + k @ (z - y)[there]
            self.covs[j] = p - k @ c[there] @ p
        before = self.w
        weighted = before * levels
        self.w = weighted / weighted.sum()
        return self.mixture(np.array(expected), np.array(seen_covs), before), math.log(weighted.sum())

    def belief(self):
        x = np.column_stack([self.s, self.means])
        covs = np.zeros((self.size, 3, 3))
        covs[:, 1:, 1:] = self.covs
        return self.mixture(x, covs, self.w)

    @staticmethod
    def mixture(means, covs, w):
        mean = w @ means
        d = means - mean
        return mean, np.einsum("j,jab->ab", w, covs) + np.einsum("j,ja,jb->ab", w, d, d) / (1.0 - w @ w)


@pytest.mark.parametrize("observe", [see, see_by_branches])
@pytest.mark.usefixtures("as_python")
def test_cycles_are_those_of_the_textbook_with_the_same_draws(observe):
    model, size = mixed_model(observe), 12
    filter_, naive = RaoBlackwellisedParticleFilter(model=model, ensemble_size=size), Textbook(model, size)
    _, (z,) = simulated(mixed_model(), 8, level=0.3)
    z = z + [[1.0, 0.5]]  # so that few particles fit, and they are resampled
    z[3, 0] = np.nan
    close, belief, resampled = {"rtol": 1e-9, "atol": 1e-11}, filter_.init(KEY), 0
    for step in range(8):
        (y, s), level = naive.update(z[step])
        belief, innovation = filter_.update(belief, z[step])
        there = ~np.isnan(z[step])
        np.testing.assert_allclose(innovation.value, np.where(there, z[step] - y, 0.0), **close)
        np.testing.assert_allclose(innovation.cov[np.ix_(there, there)], s[np.ix_(there, there)], **close)
        assert innovation.log_likelihood == pytest.approx(level, rel=1e-9)
        resampled += 1.0 / (naive.w**2).sum() < 0.5 * size
        each_close((belief.mean, belief.cov), naive.belief(), **close)
        naive.predict(0.2, step + 1)
        belief = filter_.predict(belief, [0.2])
        np.testing.assert_allclose(belief.members[0], naive.s, **close)
        np.testing.assert_allclose(filter_.particle_covariances(belief)[:, 1:, 1:], naive.covs, **close)
    assert resampled > 2


@pytest.mark.usefixtures("as_python")
def test_it_is_the_kalman_filter_where_nothing_uncertain_is_sampled():
    """A state that is known and stays what it is takes a place among the others, in the middle."""
    a, b, offset, c, shift = plane_model().matrices()
    at = np.ix_([0, 2], [0, 2])
    wider, q, p = np.eye(3), np.zeros((3, 3)), np.zeros((3, 3))
    wider[at], q[at], p[at] = a, plane_model().process_noise_cov, plane_model().prior_cov
    model = affine_model(
        a=wider,
        b=np.insert(b, 1, 0.0, axis=0),
        c=np.insert(c, 1, 0.7, axis=1),
        state_offset=np.insert(offset, 1, 0.0),
        measurement_offset=shift,
        process_noise_cov=q,
        measurement_noise_cov=plane_model().measurement_noise_cov,
        prior_mean=np.insert(plane_model().prior_mean, 1, 2.0),
        prior_cov=p,
    )
    inputs, z = simulated(model, 30, missing=0.2)
    found = run(RaoBlackwellisedParticleFilter(model=model, ensemble_size=5, sampled=[1]), [KEY], inputs, z)
    exact = run(make_filter("kf", model), [KEY], inputs, z)
    for name in ("means", "covs", "innovations", "innovation_covs", "log_likelihoods"):
        np.testing.assert_allclose(getattr(found, name), getattr(exact, name), rtol=1e-9, atol=1e-11)


@pytest.mark.usefixtures("as_python")
def test_a_sample_of_the_particles_gaussians_has_the_moments_of_the_belief():
    filter_ = RaoBlackwellisedParticleFilter(model=mixed_model(), ensemble_size=4000)
    belief = filter_.predict(filter_.init(KEY), [0.1])  # all weigh the same
    members = filter_.sample(belief)
    np.testing.assert_array_equal(members[0], belief.members[0])  # which is sampled already
    assert_normal(members[1:3], belief.cov[1:, 1:], belief.mean[1:])
    cross = np.cov(members[:3])[0, 1:] - belief.cov[0, 1:]
    assert (np.abs(cross) < 4 * np.sqrt(belief.cov[0, 0] * np.diag(belief.cov)[1:] / 4000)).all()


@pytest.mark.usefixtures("as_python")
def test_it_is_the_bootstrap_filter_where_all_states_are_sampled():
    model = line_model()
    inputs, z = simulated(model, 30, missing=0.2)
    numbers = {"ensemble_size": 20, "resampling_threshold": 0.6}
    found = run(make_filter("rbpf", model, sampled=(0, 1), **numbers), [KEY], inputs, z)
    plain = run(make_filter("pf", model, **numbers), [KEY], inputs, z)
    each_close(found, plain, rtol=1e-9, atol=1e-11)


@pytest.mark.usefixtures("as_python")
def test_regularised_particles_have_the_kernels_covariance_in_the_next_step():
    """Of a step that leaves all as it is, P_j of the others after it is what the kernel says of a joint draw."""
    model = line_model(a=np.eye(2), b=np.zeros((2, 1)), state_offset=[0.0, 0.0], process_noise_cov=[0.0, 0.1])
    size = 4
    filter_ = make_filter("rbpf", model, ensemble_size=size, resampling_threshold=1.0, regularisation=0.7)
    before, _ = filter_.update(filter_.init(KEY), [1.0])
    after = filter_.predict(before, [0.0])
    first, *_ = uniform_block(0, 0, FILTER_MEASUREMENT, *KEY)
    w = np.exp(before.members[2])
    parents = np.searchsorted(np.cumsum(w) / w.sum(), (first + np.arange(size)) / size)
    width = 0.7 * (4.0 / 3.0) ** 0.2 * size**-0.2
    drawn = width * math.sqrt(before.cov[0, 0]) * normals(FILTER_PROCESS, 1, 1, size)[0]
    np.testing.assert_allclose(after.members[0], before.members[0, parents] + drawn, rtol=1e-12)
    np.testing.assert_allclose(after.members[1], before.members[1, parents], rtol=1e-12)
    cov = filter_.particle_covariances(before)[parents, 1, 1] + 0.1
    np.testing.assert_allclose(filter_.particle_covariances(after)[:, 1, 1], cov, rtol=1e-12)


@pytest.mark.slow
def test_a_tenth_of_the_particles_is_as_good_and_compiled_code_gives_what_python_does():
    """On the example of the source: with particles for one state instead of four."""
    data, model = mixed_linear.problem.data(range(60)), mixed_linear.model()

    def found(name, size):
        filter_ = make_filter(name, model, ensemble_size=size)
        estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
        squares = ((estimates.means - data.states)[:, data.late] ** 2).mean(axis=(0, 1))
        return squares, estimates.log_likelihoods.sum(axis=1).mean()

    (few, few_level), (many, many_level), (plain, plain_level) = (
        found("rbpf", 100),
        found("pf", 1000),
        found("pf", 100),
    )
    assert (few < 1.03 * many).all() and (few < 0.9 * plain).all()
    assert few_level > many_level - 0.3 and few_level > plain_level + 5.0

    filter_ = make_filter("rbpf", model, ensemble_size=12)
    first = data.filter_keys[:1], data.inputs[:1, :15], data.measurements[:1, :16]
    compiled = run(filter_, *first)
    with interpreted():
        as_python = run(filter_, *first)
    each_close(compiled, as_python, rtol=1e-9, atol=1e-12)
