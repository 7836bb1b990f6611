"""What every filter keeps to: purity, positive covariances, missing data, one result on every path."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import FILTERS, StateSpaceModel, affine_model, make_filter, run, thruster_model, truth
from filters.registry import filter_class, tunable_numbers
from filters.session import Session
from thruster_env.compiled import interpreted
from thruster_env.streams import episode_keys, filter_keys

KEY = (123456789, 4294967295)


def wide_affine():
    """n = 3, p = 2, m = 2, stable, with offsets and correlated noise."""
    return affine_model(
        a=[[0.9, 0.2, 0.0], [-0.1, 0.8, 0.1], [0.0, 0.3, 0.7]],
        b=[[1.0, 0.0], [0.5, -0.4], [0.0, 0.8]],
        c=[[1.0, 0.0, 0.5], [0.0, 2.0, -1.0]],
        state_offset=[0.3, -0.2, 0.1],
        measurement_offset=[0.7, -1.5],
        process_noise_cov=[[0.3, 0.1, 0.0], [0.1, 0.2, -0.05], [0.0, -0.05, 0.4]],
        measurement_noise_cov=[[0.5, 0.2], [0.2, 0.3]],
        prior_mean=[1.0, -1.0, 0.5],
        prior_cov=[[1.0, 0.2, 0.0], [0.2, 0.5, 0.1], [0.0, 0.1, 0.8]],
    )


def lonely():
    """n = m = 1, without input and without constants of its own."""
    return affine_model(
        a=[[0.9]],
        b=np.zeros((1, 0)),
        c=[[2.0]],
        process_noise_cov=[0.1],
        measurement_noise_cov=[0.2],
        prior_mean=[3.0],
        prior_cov=[0.5],
    )


MODELS = {"thruster": thruster_model, "wide affine": wide_affine, "no input": lonely}


def small(name, model, size=10):
    """A filter by name; ensembles small, and of a size that fills no vector register."""
    numbers = {"ensemble_size": size} if "ensemble_size" in tunable_numbers(name) else {}
    return make_filter(name, model, **numbers)


def simulated(model, steps=20, count=1, level=3.0):
    inputs = np.random.default_rng(7).normal(size=(count, steps, model.inputs)) * level
    with interpreted():
        drawn = truth.simulate(model, episode_keys(range(count)), inputs)
    return inputs, drawn.measurements


def stepped(filter_, key, inputs, measurements):
    """The beliefs and innovations of one trajectory, by init, predict and update."""
    belief, innovation = filter_.update(filter_.init(key), measurements[0])
    found = [(belief, innovation)]
    for u, z in zip(inputs, measurements[1:], strict=True):
        belief, innovation = filter_.update(filter_.predict(belief, u), z)
        found.append((belief, innovation))
    return found


def in_session(filter_, key, inputs, measurements):
    """Rows (mean, cov, innovation, its cov) of one trajectory, by a session."""
    session = Session(filter_)
    parts = session.mean, session.cov, session.innovation, session.innovation_cov
    session.start(key, measurements[0])
    rows = [[part.copy() for part in parts]]
    for u, z in zip(inputs, measurements[1:], strict=True):
        session.step(u, z)
        rows.append([part.copy() for part in parts])
    return [np.array(part) for part in zip(*rows, strict=True)]


def equal(one, other):
    """Whether two named tuples (beliefs, innovations, estimates) hold the same numbers."""
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.fixture
def as_python():
    with interpreted():
        yield


@pytest.fixture(params=list(FILTERS))
def name(request):
    return request.param


@pytest.fixture(params=list(MODELS))
def model(request):
    return MODELS[request.param]()


NOT_ALIKE = {("enkf", 1), ("low-pass", 1), ("inversion", 1), ("kf-steady", 0), ("kf-steady", 1)}


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
        share = 4 / np.sqrt(filter_.size) if filter_.size else 0.0  # four standard errors of a mean
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
        np.testing.assert_allclose(updated.mean, belief.mean, rtol=1e-15)
        np.testing.assert_allclose(updated.cov, belief.cov, rtol=1e-15)
        np.testing.assert_array_equal(updated.members, belief.members)
        np.testing.assert_array_equal(innovation.value, np.zeros(model.m))
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

    def test_the_log_likelihood_is_the_normal_density_of_the_innovation(self, name, model):
        if not filter_class(name).gaussian_likelihood:
            return
        inputs, measurements = simulated(model)
        estimates = run(small(name, model), np.array([KEY]), inputs, measurements)
        for v, s, found in zip(
            estimates.innovations[0], estimates.innovation_covs[0], estimates.log_likelihoods[0], strict=True
        ):
            assert found == pytest.approx(multivariate_normal.logpdf(v, np.zeros(model.m), s), rel=1e-10)

    def test_the_likelihood_of_a_channel_is_its_own_where_the_other_is_missing(self, name):
        filter_ = small(name, wide_affine())
        belief = filter_.init(KEY)
        for channel, other in ((0, 1), (1, 0)):
            z = np.array([2.0, 3.0])
            z[other] = np.nan
            _, innovation = filter_.update(belief, z)
            assert innovation.value[other] == 0.0
            assert np.isfinite(innovation.cov).all()
            v, s = innovation.value[channel], innovation.cov[channel, channel]
            if filter_.gaussian_likelihood:
                assert innovation.log_likelihood == pytest.approx(multivariate_normal.logpdf(v, 0.0, s), rel=1e-10)

    # Channel 0 has the same random numbers in both models, channel 1 has not: the ensemble is left out there, as
    # are baselines that read channel 0 alone, and the filter whose gain is that of both channels together.
    @pytest.mark.parametrize(
        ("name", "channel"), [(name, c) for name in FILTERS for c in (0, 1) if (name, c) not in NOT_ALIKE]
    )
    def test_with_one_channel_missing_it_is_the_filter_of_the_other(self, name, channel):
        both = wide_affine()
        a, b, offset, c, shift = both.matrices()
        one = affine_model(
            a=a,
            b=b,
            c=c[[channel]],
            state_offset=offset,
            measurement_offset=shift[[channel]],
            process_noise_cov=both.process_noise_cov,
            measurement_noise_cov=both.measurement_noise_cov[channel, channel],
            prior_mean=both.prior_mean,
            prior_cov=both.prior_cov,
        )
        inputs, measurements = simulated(both)
        of_one = run(small(name, one), np.array([KEY]), inputs, measurements[..., [channel]])
        measurements[..., 1 - channel] = np.nan
        of_both = run(small(name, both), np.array([KEY]), inputs, measurements)
        close = {"rtol": 1e-11, "atol": 1e-11}
        np.testing.assert_allclose(of_both.means, of_one.means, **close)
        np.testing.assert_allclose(of_both.covs, of_one.covs, **close)
        np.testing.assert_allclose(of_both.innovations[..., [channel]], of_one.innovations, **close)
        own = of_both.innovation_covs[..., channel, channel]
        np.testing.assert_allclose(own, of_one.innovation_covs[..., 0, 0], **close)
        np.testing.assert_allclose(of_both.log_likelihoods, of_one.log_likelihoods, **close)

    def test_batch_loop_and_session_agree(self, name, model):
        filter_ = small(name, model)
        inputs, measurements = simulated(model)
        measurements[0, 3] = measurements[0, 7, 0] = np.nan
        agree(filter_, KEY, inputs, measurements)

    @pytest.mark.filterwarnings("ignore::RuntimeWarning")  # Python says so when a number overflows
    def test_a_diverging_filter_restarts_and_counts_and_is_never_nan(self, name):
        filter_, inputs, measurements = diverging(name)
        estimates = run(filter_, np.array([KEY]), inputs, measurements)
        found = stepped(filter_, KEY, inputs[0], measurements[0])
        assert estimates.divergences.tolist() == [found[-1][0].divergences]
        assert 1 <= estimates.divergences[0] <= 6
        for part in estimates:
            assert not np.isnan(part).any()
        assert np.isfinite(estimates.means).all() and np.isfinite(estimates.covs).all()
        np.testing.assert_array_equal(estimates.means[0], [belief.mean for belief, _ in found])
        np.testing.assert_array_equal(estimates.covs[0], [belief.cov for belief, _ in found])
        assert all(np.isfinite(innovation.value).all() for _, innovation in found)

    @pytest.mark.parametrize("u", [[1.0, 2.0, 3.0], [1.0, np.nan], [np.inf, 0.0]])
    def test_a_wrong_input_is_refused(self, name, u):
        filter_ = small(name, wide_affine())
        with pytest.raises(ValueError, match="u must be 2 numbers, each finite, but got"):
            filter_.predict(filter_.init(KEY), u)

    @pytest.mark.parametrize("z", [[1.0], [1.0, np.inf]])
    def test_a_wrong_measurement_is_refused(self, name, z):
        filter_ = small(name, wide_affine())
        with pytest.raises(ValueError, match="z must be 2 numbers, each finite or NaN, but got"):
            filter_.update(filter_.init(KEY), z)


def model_constants(filter_):
    return filter_.kernel_model.constants


def mean_at_sigma_points(filter_, belief):
    """The mean (m,) of what is measured at the points around a belief's mean."""
    model, (spread, weight, _), root = filter_.model, filter_.own_numbers, np.linalg.cholesky(belief.cov)
    points = belief.mean + spread * np.vstack([root.T, -root.T])
    seen = [model.observe(tuple(x), model.constants) for x in (belief.mean, *points)]
    return (1 - 2 * model.n * weight) * np.array(seen[0]) + weight * np.sum(seen[1:], axis=0)


def agree(filter_, key, inputs, measurements):
    """Assert that batch, loop and session give one trajectory alike."""
    close = {"rtol": 1e-12, "atol": 1e-12}
    estimates = run(filter_, np.array([key]), inputs, measurements)
    found = stepped(filter_, key, inputs[0], measurements[0])
    np.testing.assert_allclose(estimates.means[0], [belief.mean for belief, _ in found], **close)
    np.testing.assert_allclose(estimates.covs[0], [belief.cov for belief, _ in found], **close)
    np.testing.assert_allclose(estimates.innovations[0], [i.value for _, i in found], **close)
    np.testing.assert_allclose(estimates.innovation_covs[0], [i.cov for _, i in found], **close)
    np.testing.assert_allclose(estimates.log_likelihoods[0], [i.log_likelihood for _, i in found], **close)
    for part, of_session in zip(estimates[:4], in_session(filter_, key, inputs[0], measurements[0]), strict=True):
        np.testing.assert_allclose(part[0], of_session, **close)


def diverging(name):
    """A filter whose model overflows every second step, or every step if it needs a steady gain, with data."""
    a, b = (0.5, 1e200) if name == "kf-steady" else (1e180, 1.0)
    model = affine_model(
        a=[[a]],
        b=[[b]],
        c=[[1.0]],
        process_noise_cov=[0.1],
        measurement_noise_cov=[0.2],
        prior_mean=[1.0],
        prior_cov=[0.5],
    )
    return small(name, model), np.full((1, 6, 1), b), np.ones((1, 7, 1))


@pytest.mark.parametrize("kind", ["thruster", "wide affine"])
def test_compiled_and_interpreted_agree(name, kind):
    model = MODELS[kind]()
    filter_ = small(name, model)
    inputs, measurements = simulated(model, 25)
    measurements[0, 3] = measurements[0, 7, 0] = np.nan
    data = np.array([KEY]), inputs, measurements
    compiled = run(filter_, *data)
    with interpreted():
        as_python = run(filter_, *data)
    for one, other in zip(compiled, as_python, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_compiled_batch_loop_and_session_agree_over_500_steps(name):
    model = thruster_model()
    inputs, measurements = simulated(model, 500, level=8.0)
    measurements[0, 100:120] = np.nan
    agree(small(name, model), KEY, inputs, measurements)


def test_a_trajectory_does_not_depend_on_its_company(name):
    model = thruster_model()
    inputs, measurements = simulated(model, 30, count=19)
    keys, filter_ = filter_keys(range(19)), small(name, model)
    together = run(filter_, keys, inputs, measurements)
    backwards = run(filter_, keys[::-1], inputs[::-1], measurements[::-1])
    assert equal(together, [part[::-1] for part in backwards])
    for b in range(19):
        alone = run(filter_, keys[b : b + 1], inputs[b : b + 1], measurements[b : b + 1])
        assert equal(alone, [part[b : b + 1] for part in together])


def test_the_same_key_gives_the_same_numbers_and_only_ensembles_use_it(name):
    model = thruster_model()
    inputs, measurements = simulated(model, 30)
    filter_ = small(name, model)
    first, again, other = (run(filter_, filter_keys([s]), inputs, measurements) for s in (1, 1, 2))
    assert equal(first, again)
    assert (filter_.size > 0) == (not np.array_equal(first.means, other.means))


UNIT_FREE = ["kf", "kf-steady", "ekf", "iekf", "ukf", "ckf", "enkf", "etkf", "ensrf", "denkf", "ienkf"]
UNIT_FREE += ["pf", "apf", "sage-husa", "vb", "ekf-robust", "open-loop"]


# A power of two is exact; 1000 and 0.01 are what units do.
@pytest.mark.parametrize("name", UNIT_FREE)
@pytest.mark.parametrize(
    ("states", "channels"), [((1000.0, 0.01, 7.0), (60.0, 1e-3)), ((2.0**20,) * 3, (8.0, 1.0))]
)
def test_a_change_of_units_changes_no_estimate(name, states, channels):
    model = wide_affine()
    d, e = np.diag(states), np.diag(channels)
    a, b, offset, c, shift = model.matrices()
    rescaled = affine_model(
        a=d @ a @ np.linalg.inv(d),
        b=d @ b,
        c=e @ c @ np.linalg.inv(d),
        state_offset=d @ offset,
        measurement_offset=e @ shift,
        process_noise_cov=d @ model.process_noise_cov @ d,
        measurement_noise_cov=e @ model.measurement_noise_cov @ e,
        prior_mean=d @ model.prior_mean,
        prior_cov=d @ model.prior_cov @ d,
    )
    inputs, measurements = simulated(model, 50)
    with interpreted():
        before = run(small(name, model), np.array([KEY]), inputs, measurements)
        after = run(small(name, rescaled), np.array([KEY]), inputs, measurements @ e)
    np.testing.assert_allclose(after.means / states, before.means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(after.covs / np.outer(states, states), before.covs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", UNIT_FREE)
@pytest.mark.parametrize("analytic", [True, False])
def test_a_change_of_units_of_a_nonlinear_model_changes_no_estimate(name, analytic):
    model, states, thrusts = thruster_model(), (2.0**10, 2.0**-7), 2.0**-10

    def physical(x):
        return x[0] / states[0], x[1] / states[1]

    def transition(x, u, c):
        omega, flow = model.transition(physical(x), u, c)
        return omega * states[0], flow * states[1]

    def transition_jacobian(x, u, c):
        rows = model.transition_jacobian(physical(x), u, c)
        return tuple(tuple(rows[i][j] * states[i] / states[j] for j in range(2)) for i in range(2))

    def observe(x, c):
        return (model.observe(physical(x), c)[0] * thrusts,)

    def observe_jacobian(x, c):
        (row,) = model.observe_jacobian(physical(x), c)
        return (tuple(row[j] * thrusts / states[j] for j in range(2)),)

    if not analytic:
        model = model.replace(transition_jacobian=None, observe_jacobian=None)
    rescaled = StateSpaceModel(
        transition=transition,
        observe=observe,
        transition_jacobian=transition_jacobian if analytic else None,
        observe_jacobian=observe_jacobian if analytic else None,
        process_noise_cov=model.process_noise_cov * np.outer(states, states),
        measurement_noise_cov=model.measurement_noise_cov * thrusts**2,
        prior_mean=model.prior_mean * states,
        prior_cov=model.prior_cov * np.outer(states, states),
        constants=model.constants,
        substeps=model.substeps,
        operating_state=model.operating_state * states,
        operating_input=model.operating_input,
    )
    inputs, measurements = simulated(model, 50, level=8.0)
    with interpreted():
        before = run(small(name, model), np.array([KEY]), inputs, measurements)
        after = run(small(name, rescaled), np.array([KEY]), inputs, measurements * thrusts)
    np.testing.assert_allclose(after.means / states, before.means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(after.covs / np.outer(states, states), before.covs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("keys", "inputs", "measurements", "rule"),
    [
        ((3, 2), (2, 5, 1), (2, 6, 1), "shapes"),
        ((2, 1), (2, 5, 1), (2, 6, 1), "shapes"),
        ((2, 2), (2, 6, 1), (2, 6, 1), "shapes"),
        ((2, 2), (2, 5, 2), (2, 6, 1), "shapes"),
        ((2, 2), (2, 5, 1), (2, 6, 2), "shapes"),
        ((2, 2), (2, 5), (2, 6), "shapes"),
        ((2, 2), (2, 0, 1), (2, 0, 1), "shapes"),
    ],
)
def test_a_batch_whose_shapes_do_not_fit_is_refused(keys, inputs, measurements, rule):
    data = np.zeros(keys), np.zeros(inputs), np.zeros(measurements)
    with pytest.raises(ValueError, match=rule):
        run(make_filter("ekf", thruster_model()), *data)


@pytest.mark.parametrize(("u", "z"), [(np.nan, 0.0), (np.inf, 0.0), (0.0, np.inf)])
def test_a_batch_with_numbers_that_are_not_finite_is_refused(u, z):
    with pytest.raises(ValueError, match="inputs must be finite, and measurements finite or NaN"):
        run(make_filter("ekf", thruster_model()), np.zeros((1, 2)), np.full((1, 1, 1), u), np.full((1, 2, 1), z))


@pytest.mark.usefixtures("as_python")
def test_a_batch_of_no_trajectories_gives_no_estimates(name):
    estimates = run(small(name, thruster_model()), np.zeros((0, 2)), np.zeros((0, 5, 1)), np.zeros((0, 6, 1)))
    assert estimates.means.shape == (0, 6, 2)
    assert estimates.divergences.shape == (0,)


class TestNoiseThatVaries:
    def test_a_step_may_have_its_own_noise_as_if_the_model_had_it(self, name):
        model = wide_affine()
        inputs, measurements = simulated(model, 1)
        q, r = 3.0 * model.process_noise_cov, 0.2 * model.measurement_noise_cov
        with interpreted():
            filter_ = small(name, model)
            if not filter_.varying_noise:
                with pytest.raises(ValueError, match="cannot vary"):
                    filter_.predict(filter_.init(KEY), inputs[0, 0], process_noise_cov=q)
                return
            other = small(name, model.replace(process_noise_cov=q, measurement_noise_cov=r))
            belief = filter_.init(KEY)
            one, _ = filter_.update(
                filter_.predict(belief, inputs[0, 0], process_noise_cov=q),
                measurements[0, 1],
                measurement_noise_cov=r,
            )
            two, _ = other.update(other.predict(belief, inputs[0, 0]), measurements[0, 1])
        np.testing.assert_allclose(one.mean, two.mean, rtol=1e-12)
        np.testing.assert_allclose(one.cov, two.cov, rtol=1e-10, atol=1e-14)

    def test_a_batch_with_varying_noise_is_the_loop(self, name):
        model = wide_affine()
        inputs, measurements = simulated(model, 4, count=2)
        qs = np.array([scale * model.process_noise_cov for scale in (1.0, 4.0, 0.5, 2.0)])
        rs = np.array([scale * model.measurement_noise_cov for scale in (2.0, 0.5, 1.0, 3.0, 0.3)])
        filter_ = small(name, model)
        if not filter_.varying_noise:
            return
        keys = filter_keys(range(2))
        found = run(filter_, keys, inputs, measurements, process_noise_covs=qs, measurement_noise_covs=rs)
        for b in range(2):
            belief = filter_.init(tuple(int(k) for k in keys[b]))
            for k in range(5):
                if k > 0:
                    belief = filter_.predict(belief, inputs[b, k - 1], process_noise_cov=qs[k - 1])
                belief, _ = filter_.update(belief, measurements[b, k], measurement_noise_cov=rs[k])
                np.testing.assert_allclose(found.means[b, k], belief.mean, rtol=1e-9, atol=1e-12)
                np.testing.assert_allclose(found.covs[b, k], belief.cov, rtol=1e-9, atol=1e-12)
