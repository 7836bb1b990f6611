"""A filter over a log: what its innovations tell, errors against channels it did not see, smoothers, files."""

import math

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

from filters import make_filter, run, smooth
from filters.logs.estimate import estimate
from filters.logs.findings import columns_of, compared, draw_log, findings
from tests.thruster_env.logs.test_logs import MODEL
from thruster_env.core.streams import filter_keys
from thruster_env.logs.log import Log
from thruster_env.model.quantities import Quantity
from thruster_env.model.simulate import simulate

POWER = Quantity("power", "P", "W")


def power(x, c):
    return 3.0 * x[0] * x[0]


SEEN = MODEL.replace(outputs={"P": (POWER, power)})
STEPS = 400


@pytest.fixture(scope="module")
def log():
    inputs = np.sin(0.1 * np.arange(STEPS))[None, :, None]
    truth = simulate(MODEL, np.array([[3, 8]]), inputs)
    measured = truth.measurements[0].copy()
    measured[[5, 90, 300]] = np.nan
    states = truth.states[0, :, 0]
    references = {"state:n": states, "output:P": 3.0 * states**2, "output:other": states}
    referred = {"state:n": MODEL.states[0], "output:P": POWER, "output:other": POWER}
    return Log("run", 0.1, inputs[0], measured, MODEL.input_quantities, MODEL.measurements, references, referred)


def test_an_estimate_is_what_the_filter_gives_of_a_batch(log):
    found = estimate(log, "kf", SEEN)
    batch = run(make_filter("kf", SEEN), filter_keys([0]), log.inputs[None], log.measurements[None])
    np.testing.assert_allclose(found.means, batch.means[0], rtol=1e-12)
    np.testing.assert_allclose(found.log_likelihoods, batch.log_likelihoods[0], rtol=1e-9)
    assert (
        np.isnan(found.innovations[[5, 90, 300]]).all()
        and np.isfinite(np.delete(found.innovations, [5, 90, 300])).all()
    )


def test_the_findings_are_those_of_the_rows_that_count(log):
    found = estimate(log, "kf", SEEN)
    told = findings(found, skip=10)
    late, there = slice(10, None), ~np.isnan(log.measurements[10:, 0])
    v, s = found.innovations[late, 0][there], found.innovation_covs[late, 0, 0][there]
    assert told.rows == there.sum() == 389
    assert told.mean_nis == pytest.approx((v**2 / s).mean(), rel=1e-12)
    assert told.nis_band == pytest.approx(chi2.ppf([0.025, 0.975], 389) / 389, rel=1e-9)
    assert told.nis_band[0] < told.mean_nis < told.nis_band[1] and told.whiteness.p_value > 0.05
    expected = sum(multivariate_normal.logpdf(*pair) for pair in zip(v, np.zeros_like(v), s, strict=True))
    assert told.log_likelihood == pytest.approx(expected, rel=1e-9)
    (ahead,) = told.predictions
    assert ahead.rmse == pytest.approx(np.sqrt((v**2).mean())) and ahead.bias == pytest.approx(-v.mean())
    assert list(compared(found)) == ["state:n", "output:P"]  # the model knows of no other
    state, of_power = told.references
    errors = found.means[late, 0] - log.references["state:n"][late]
    assert (state.rmse, state.bias) == pytest.approx((np.sqrt((errors**2).mean()), errors.mean()))
    assert of_power.quantity == POWER and of_power.rows == 391


def test_an_output_has_the_deviation_of_its_linearisation(log):
    found = estimate(log, "kf", SEEN)
    values, std = found.output("P")
    np.testing.assert_allclose(values, 3.0 * found.means[:, 0] ** 2)
    np.testing.assert_allclose(std, 6.0 * abs(found.means[:, 0]) * found.stds[:, 0], rtol=1e-5, atol=1e-9)


def test_a_wrong_noise_shows_in_the_innovations(log):
    sure = findings(estimate(log, "kf", SEEN, model_arguments={"process_noise_cov": [1e-3]}))
    assert sure.mean_nis > sure.nis_band[1] and sure.whiteness.p_value < 1e-3
    unsure = findings(estimate(log, "kf", SEEN, model_arguments={"measurement_noise_cov": [1.0]}))
    assert unsure.mean_nis < unsure.nis_band[0]


def test_a_smoother_is_closer_to_the_truth(log):
    found = estimate(log, "kf", SEEN, smoother=True)
    data = filter_keys([0]), log.inputs[None], log.measurements[None]
    np.testing.assert_array_equal(found.means, smooth(make_filter("kf", SEEN), *data).means[0])
    told = findings(found).references[0]
    assert told.rmse < 0.95 * findings(estimate(log, "kf", SEEN)).references[0].rmse
    lagged = estimate(log, "kf", SEEN, lag=3)  # which asks for a smoother, too
    assert lagged.smoothed
    np.testing.assert_array_equal(lagged.means, smooth(make_filter("kf", SEEN), *data, 3).means[0])


def test_a_filter_without_a_covariance_has_errors_alone(log):
    told = findings(estimate(log, "open-loop", SEEN))
    assert np.isnan(told.mean_nis) and np.isnan(told.log_likelihood) and told.whiteness is None
    assert told.references[0].rmse > 0


def test_columns_hold_all_of_it(log):
    found = estimate(log, "kf", SEEN)
    columns = columns_of(found)
    assert list(columns)[:4] == ["time_s", "input_V_s_V", "measured_tach_rad_per_s", "reference_n_rad_per_s"]
    np.testing.assert_array_equal(columns["n_rad_per_s"], found.means[:, 0])
    np.testing.assert_array_equal(columns["std_n_rad_per_s"], found.stds[:, 0])
    np.testing.assert_array_equal(columns["innovation_tach_rad_per_s"], found.innovations[:, 0])
    assert {"P_W", "std_P_W", "reference_P_W", "innovation_std_tach_rad_per_s"} <= set(columns)


def test_what_is_measured_stands_behind_the_state_or_output_that_it_measures(log):
    drawn = [
        [dots.get_offsets()[:, 1] for dots in axis.collections if dots.get_label() == "measurement"]
        for axis in draw_log(estimate(log, "kf", SEEN), "kf on run").axes
    ]
    (speed,), *others = drawn  # h(x) = n
    np.testing.assert_array_equal(speed.filled(np.nan), log.measurements[:, 0])
    assert others == [[], []]  # the output P and the innovation


def test_an_estimate_at_which_h_has_no_value_is_drawn_all_the_same(log):
    def root(x, c):
        return (math.sqrt(x[0]),)

    own = make_filter("ekf", SEEN.replace(prior_mean=[1.0], observe=root, observe_jacobian=None))
    axes = draw_log(estimate(log, "kf", SEEN)._replace(filter=own), "ekf").axes
    assert not any(dots.get_label() == "measurement" for axis in axes for dots in axis.collections)
