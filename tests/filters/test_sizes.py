"""Any number of states and sensors, in any unit: every filter, on every path, and Kalman's numbers."""

import numpy as np
import pytest

from filters import make_filter, run
from filters.engine.belief import restart_if_lost
from filters.registry import FILTERS
from tests.filters.checks import refused
from tests.models import KEY, random_affine, rescaled, simulated, small, wide_model
from tests.oracles import each_close, kalman_filter
from thruster_env.core.compiled import interpreted
from thruster_env.core.sources import Source

KEYS = np.array([KEY])
EXACT = {
    **{name: {} for name in ("kf", "ekf", "iekf", "ukf", "ckf", "schmidt", "fuzzy")},
    "mhe": {"loss": "quadratic"},
    "sage-husa": {"forgetting_factor": 1.0},
    "ekf-robust": {"degrees_of_freedom": 1e12},
    "vb": {"forgetting_factor": 1.0, "prior_weight": 1e12},
}
FORMS = [(name, form) for name in ("kf", "ekf") for form in ("covariance", "square-root", "ud")]
FORMS += [("kf", "information")]
SIZES = [(2, 12), (1, 16), (5, 10), (12, 4)]  # of sensors or of states a matrix is large


def made(name, model):
    if name == "fuzzy":
        return make_filter(name, model, low=-5.0 * np.ones(model.n), high=5.0 * np.ones(model.n), premises=[0])
    return make_filter(name, model, **EXACT[name]) if name in EXACT else small(name, model)


def drawn(n, m, seed=0):
    """A model, inputs and five measurements, of many states two, one channel or all of them missing in two."""
    rng, rows = np.random.default_rng((n, m, seed)), 5 if n < 12 else 2
    model, z = random_affine(n, m, seed=seed), rng.normal(size=(1, rows, m)) * 3.0
    z[0, 1, 0] = z[0, 3:4] = np.nan
    return model, rng.normal(size=(1, rows - 1, 2)), z


def stepped(filter_, inputs, z):
    """Mean and covariance after all steps of one belief."""
    belief = filter_.init(KEY)
    for k, one in enumerate(z[0]):
        belief = belief if k == 0 else filter_.predict(belief, inputs[0, k - 1])
        belief, _ = filter_.update(belief, one)
    return belief.mean, belief.cov


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.usefixtures("as_python")
def test_any_number_of_sensors_is_filtered_in_runs_and_by_steps(name):
    for n, m in SIZES[:1] if name not in EXACT else SIZES[-1:] if EXACT[name] else SIZES:
        model, inputs, z = drawn(n, m)
        filter_ = made(name, model)
        found = run(filter_, KEYS, inputs, z)
        assert np.isfinite(found.means).all() and not found.divergences.any()
        mean, cov = stepped(filter_, inputs, z)
        each_close((mean, cov), (found.means[0, -1], found.covs[0, -1]), rtol=1e-9, atol=1e-9)
        if name in EXACT:
            means, covs, levels = kalman_filter(model, inputs[0], z[0])
            each_close((found.means[0], found.covs[0]), (means, covs), rtol=1e-8, atol=1e-8)
            np.testing.assert_allclose(found.log_likelihoods[0], levels, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(("name", "form"), FORMS)
@pytest.mark.parametrize(("n", "m"), [(8, 20), (18, 2), (40, 40)])
@pytest.mark.usefixtures("as_python")
def test_all_forms_of_models_of_any_size_are_kalman_s(name, form, n, m):
    model, inputs, z = drawn(n, m)
    filter_ = make_filter(name, model, form=form)
    found, (means, covs, levels) = run(filter_, KEYS, inputs, z), kalman_filter(model, inputs[0], z[0])
    each_close((found.means[0], found.covs[0]), (means, covs), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found.log_likelihoods[0], levels, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "fields", "n", "m"), [("kf", {}, 3, 12), ("ekf", {"form": "ud"}, 8, 20)])
def test_compiled_code_of_many_sensors_has_these_numbers_too(name, fields, n, m):
    model, inputs, z = drawn(n, m)
    filter_ = make_filter(name, model, **fields)
    found, (means, covs, _) = run(filter_, KEYS, inputs, z), kalman_filter(model, inputs[0], z[0])
    np.testing.assert_allclose(found.means[0], means, rtol=1e-8, atol=1e-8)
    mean, cov = stepped(filter_, inputs, z)
    each_close((mean, cov), (means[-1], covs[-1]), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("m", [1, 12])
def test_a_negative_variance_is_lost_for_any_number_of_sensors(m):
    model = random_affine(2, m)
    filter_ = make_filter("kf", model)
    kernels = filter_.kernels()
    restart = restart_if_lost.__wrapped__(kernels._replace(start=lambda *_: None, summarise=lambda *_: None))

    def restarts(row):
        row[kernels.layout.divergences] = 0.0
        restart((row, None, None), np.ones(1000), 0)
        return row[kernels.layout.divergences]

    assert not restarts(np.ones(1000))
    for place, value in ((2, -1e-9), (5, np.nan), (0, np.inf)):  # of a variance, a variance, a mean
        lost = np.ones(1000)
        lost[place] = value
        assert restarts(lost) == 1.0
    row = np.ones(1000)
    row[3] = -0.5  # a covariance
    assert not restarts(row)


def test_a_shape_of_no_argument_is_an_error():
    refused(r"magnitude\(row\) has no argument cov", Source, "magnitude", "row", work=1000, cov=(2, 2))


UNIT_FREE = ["kf", "kf-steady", "ekf", "iekf", "ukf", "ckf", "enkf", "etkf", "ensrf", "denkf", "ienkf"]
UNIT_FREE += ["enkf-n", "rhf", "pf", "apf", "rbpf", "sage-husa", "vb", "ekf-robust", "mhe", "open-loop"]


# A power of two is exact; 1000 and 0.01 are what units do.
@pytest.mark.parametrize("name", UNIT_FREE)
@pytest.mark.parametrize(
    ("states", "channels"), [((1000.0, 0.01, 7.0), (60.0, 1e-3)), ((2.0**20,) * 3, (8.0, 1.0))]
)
def test_a_change_of_units_changes_no_estimate(name, states, channels):
    model = wide_model()
    other = rescaled(model, states, channels)
    inputs, measurements = simulated(model, 50)
    with interpreted():
        before = run(small(name, model), KEYS, inputs, measurements)
        after = run(small(name, other), KEYS, inputs, measurements * channels)
    np.testing.assert_allclose(after.means / states, before.means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(after.covs / np.outer(states, states), before.covs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["kf", "kf-steady", "ukf"])
def test_units_that_differ_by_many_orders_change_no_estimate(name):
    test_a_change_of_units_changes_no_estimate(name, (1e9, 3e-9, 7e4), (2e-8, 5e8))
