"""What every filter keeps to: purity, positive covariances, missing data, its own noise, refusals."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import FILTERS, run
from filters.ensembles.ensemble import EnsembleFilter
from filters.particles.kernels import WeightedFilter
from tests.filters.checks import refused
from tests.models import KEY, MODELS, simulated, small, state_space, varying_noise, wide_model
from tests.oracles import each_close, each_equal, equal
from thruster_env.core.streams import filter_keys

GAUSSIAN = [name for name, kind in FILTERS.items() if kind.gaussian_likelihood]
OF_MEMBERS = [name for name, kind in FILTERS.items() if issubclass(kind, (EnsembleFilter, WeightedFilter))]
VARYING = [name for name, kind in FILTERS.items() if kind.varying_noise]
NOT_ALIKE = {("enkf", 1), ("low-pass", 1), ("inversion", 1), ("kf-steady", 0), ("kf-steady", 1)}


@pytest.fixture(params=list(FILTERS))
def name(request):
    return request.param


@pytest.fixture(params=list(MODELS))
def model(request):
    return MODELS[request.param]()


@pytest.mark.usefixtures("as_python")
class TestInPython:
    def test_predict_and_update_are_pure(self, name, model):
        filter_ = small(name, model)
        inputs, measurements = simulated(model, 2)
        belief, _ = filter_.update(filter_.init(KEY), measurements[0, 0])
        u, z = inputs[0, 0].copy(), measurements[0, 1].copy()
        kept = [np.copy(part) for part in belief]

        predicted = filter_.predict(belief, u)
        updated, innovation = filter_.update(predicted, z)
        filter_.update(filter_.predict(updated, inputs[0, 1]), measurements[0, 2])  # other work in between
        assert equal(predicted, filter_.predict(belief, u))
        assert equal(updated, filter_.update(predicted, z)[0])
        assert equal(innovation, filter_.update(predicted, z)[1])

        for result in (predicted, updated):
            for array in (result.mean, result.cov, result.members):
                array[:] = np.nan  # what a caller does with a result touches nothing else
        innovation.value[:] = innovation.cov[:] = np.nan
        assert equal(belief, kept)
        assert (u == inputs[0, 0]).all() and (z == measurements[0, 1]).all()
        assert np.isfinite(filter_.predict(belief, u).mean).all()

    def test_a_belief_counts_its_steps_and_keeps_its_key(self, name, model):
        filter_ = small(name, model)
        belief = filter_.init(KEY)
        assert (belief.key, belief.step, belief.divergences) == (KEY, 0, 0)
        assert belief.members.shape == (filter_.kernels().kept_rows, filter_.size)
        for step in (1, 2):
            belief = filter_.predict(belief, np.zeros(model.inputs))
            belief, _ = filter_.update(belief, np.zeros(model.m))
            assert (belief.key, belief.step, belief.divergences) == (KEY, step, 0)

    def test_the_first_belief_is_the_prior(self, name, model):
        filter_ = small(name, model, size=2000)
        belief = filter_.init(KEY)
        spread = np.sqrt(np.diag(model.prior_cov))
        share = 4 / np.sqrt(filter_.size) if filter_.size else 1e-14  # four standard errors of a mean, or rounding
        assert (np.abs(belief.mean - model.prior_mean) <= share * spread).all()
        prior_cov = model.prior_cov if filter_.has_covariance else np.zeros((model.n, model.n))
        assert (np.abs(belief.cov - prior_cov) <= 1.5 * share * np.outer(spread, spread)).all()

    def test_covariances_are_symmetric_and_positive(self, name, model):
        inputs, measurements = simulated(model, 30)
        measurements[0, 10:13] = np.nan
        filter_ = small(name, model)
        estimates = run(filter_, np.array([KEY]), inputs, measurements)
        for covs in (estimates.covs[0], estimates.innovation_covs[0]):
            assert (covs == covs.transpose(0, 2, 1)).all()
            assert (np.linalg.eigvalsh(covs) > 0).all() or (not filter_.has_covariance and (covs == 0).all())
        assert estimates.divergences.tolist() == [0]

    def test_without_a_measurement_it_only_predicts(self, name, model):
        filter_ = small(name, model)
        belief = filter_.predict(filter_.init(KEY), np.ones(model.inputs))
        updated, innovation = filter_.update(belief, np.full(model.m, np.nan))
        each_close((updated.mean, updated.cov), (belief.mean, belief.cov), rtol=1e-15)
        each_equal((updated.members, innovation.value), (belief.members, np.zeros(model.m)))
        assert np.isfinite(innovation.cov).all()
        assert (np.linalg.eigvalsh(innovation.cov) > 0).all() or not filter_.has_covariance
        assert innovation.log_likelihood == 0.0

    def test_the_innovation_is_what_was_measured_less_what_was_expected(self, name, model):
        filter_ = small(name, model, size=300)
        belief = filter_.predict(filter_.init(KEY), np.ones(model.inputs))
        z = np.arange(5.0, 5.0 + model.m)
        if name == "fuzzy":
            means, _, weights = filter_.rule_estimates(belief)
            seen = [rule.observe(tuple(x), rule.constants) for rule, x in zip(filter_.rules, means, strict=True)]
            expected = weights @ seen
        elif name == "gsf":
            nodes, weights, _ = filter_.standard_split
            points = belief.mean + nodes[:, None] * belief.cov[:, -1] / np.sqrt(belief.cov[-1, -1])
            expected = weights @ [model.observe(tuple(x), model.constants) for x in points]
        elif name in ("ukf", "ckf"):
            expected = mean_at_sigma_points(filter_, belief)
        else:
            points = belief.members[: model.n].T if filter_.size else [belief.mean]
            seen = [filter_.kernel_model.observe(tuple(x), model_constants(filter_)) for x in points]
            expected = np.mean(seen, axis=0)
        updated, innovation = filter_.update(belief, z)
        np.testing.assert_allclose(innovation.value, z - expected, rtol=1e-12, atol=1e-12)
        nearer = [abs(filter_.update(updated, z)[1].value), abs(innovation.value)]
        if filter_.has_covariance:
            assert nearer[0].sum() < nearer[1].sum()  # the estimate moved towards the measurement

    @pytest.mark.parametrize("name", GAUSSIAN)
    def test_the_log_likelihood_is_the_normal_density_of_what_is_measured(self, name, model):
        inputs, z = simulated(model, 20, missing=0.3)
        estimates = run(small(name, model), np.array([KEY]), inputs, z)
        assert np.isfinite(estimates.innovation_covs).all() and (estimates.innovations[np.isnan(z)] == 0.0).all()
        for there, v, s, found in zip(~np.isnan(z[0]), *(part[0] for part in estimates[2:5]), strict=True):
            expected = multivariate_normal(cov=s[np.ix_(there, there)]).logpdf(v[there]) if there.any() else 0.0
            assert found == pytest.approx(expected, rel=1e-10)

    # Channel 0 has the same random numbers in both models, channel 1 has not: the ensemble is left out there, as
    # are baselines that read channel 0 alone, and the filter whose gain is that of both channels together.
    @pytest.mark.parametrize(
        ("name", "channel"), [(name, c) for name in FILTERS for c in (0, 1) if (name, c) not in NOT_ALIKE]
    )
    def test_with_one_channel_missing_it_is_the_filter_of_the_other(self, name, channel):
        both = wide_model()
        _, _, _, c, shift = both.matrices()
        one = wide_model(
            c=c[[channel]],
            measurement_offset=shift[[channel]],
            measurement_noise_cov=both.measurement_noise_cov[channel, channel],
        )
        inputs, measurements = simulated(both, 20)
        of_one = run(small(name, one), np.array([KEY]), inputs, measurements[..., [channel]])
        measurements[..., 1 - channel] = np.nan
        of_both = run(small(name, both), np.array([KEY]), inputs, measurements)
        close = {"rtol": 1e-11, "atol": 1e-11}
        each_close((of_both.means, of_both.covs), (of_one.means, of_one.covs), **close)
        np.testing.assert_allclose(of_both.innovations[..., [channel]], of_one.innovations, **close)
        own = of_both.innovation_covs[..., channel, channel]
        np.testing.assert_allclose(own, of_one.innovation_covs[..., 0, 0], **close)
        np.testing.assert_allclose(of_both.log_likelihoods, of_one.log_likelihoods, **close)

    @pytest.mark.parametrize("u", [[1.0, 2.0, 3.0], [1.0, np.nan], [np.inf, 0.0]])
    def test_a_wrong_input_is_refused(self, name, u):
        filter_ = small(name, wide_model())
        refused("u must be 2 numbers, each finite, but got", filter_.predict, filter_.init(KEY), u)

    @pytest.mark.parametrize("z", [[1.0], [1.0, np.inf]])
    def test_a_wrong_measurement_is_refused(self, name, z):
        filter_ = small(name, wide_model())
        refused("z must be 2 numbers, each finite or NaN, but got", filter_.update, filter_.init(KEY), z)


def model_constants(filter_):
    return filter_.kernel_model.constants


def mean_at_sigma_points(filter_, belief):
    """The mean (m,) of what is measured at the points around a belief's mean."""
    model, (spread, weight, *_), root = filter_.model, filter_.own_parameters, np.linalg.cholesky(belief.cov)
    points = belief.mean + spread * np.vstack([root.T, -root.T])
    seen = [model.observe(tuple(x), model.constants) for x in (belief.mean, *points)]
    return (1 - 2 * model.n * weight) * np.array(seen[0]) + weight * np.sum(seen[1:], axis=0)


def needs_positive(x, u, c):
    return (math.log(x[0]) + 3.0,)


def see(x, c):
    return (x[0],)


@pytest.mark.parametrize("name", OF_MEMBERS)
@pytest.mark.usefixtures("as_python")
def test_only_real_members_are_put_through_the_model(name):
    """What pads members to full vector registers must not fail where no member does."""
    model = state_space(needs_positive, see, q=[0.01], r=[0.01], mean=[5.0], cov=[0.01])
    filter_ = small(name, model, size=5)
    belief = filter_.predict(filter_.init(KEY), [0.0])
    assert belief.mean[0] == pytest.approx(math.log(5.0) + 3.0, abs=0.3)
    for _ in range(20):
        belief, _ = filter_.update(filter_.predict(belief, [0.0]), [4.5])
    assert belief.mean[0] == pytest.approx(4.5, abs=0.3)


@pytest.mark.parametrize("name", VARYING)
@pytest.mark.usefixtures("as_python")
def test_a_batch_with_varying_noise_is_the_loop(name):
    model = wide_model()
    inputs, measurements = simulated(model, 4, count=2)
    noise = varying_noise(model, 4)
    qs, rs = noise.values()
    filter_ = small(name, model)
    keys = filter_keys(range(2))
    found = run(filter_, keys, inputs, measurements, **noise)
    for b in range(2):
        belief = filter_.init(tuple(int(k) for k in keys[b]))
        for k in range(5):
            if k > 0:
                belief = filter_.predict(belief, inputs[b, k - 1], process_noise_cov=qs[k - 1])
            belief, _ = filter_.update(belief, measurements[b, k], measurement_noise_cov=rs[k])
            each_close((found.means[b, k], found.covs[b, k]), (belief.mean, belief.cov), rtol=1e-9, atol=1e-12)
