import json

import numpy as np
import pytest

from filters import EnsembleKalmanFilter, ExtendedKalmanFilter, run
from plants.simulate import simulate
from studies import VEHICLE_STUDIES, ngatini2017, ngatini2019
from studies.vehicle.estimators import Estimator, kalman, measured
from studies.vehicle.experiment import (
    Task,
    along_path,
    for_all,
    keys_of,
    measured_velocities,
    noise_free,
    run_tasks,
    scores_of,
    true_runs,
)
from studies.vehicle.findings import why_different
from studies.vehicle.mean_propagation import MeanPropagatingEnKF
from studies.vehicle.models import papers_model
from studies.vehicle.paths import PATHS, find_path
from studies.vehicle.pose import full_pose, planar_pose, reckoned_attitude
from studies.vehicle.printed import DT, PrintedRow
from studies.vehicle.statements import GOLDEN, MEAN_ONLY, unstable_corners
from studies.vehicle.tasks import PAPERS, tasks_of
from studies.vehicle.wording import digits
from tests.oracles import kalman_update

ENDS = {  # (north, east, down) [m], of a prototype with other code
    "I": (-2.415, 3.789, 0.114),
    "II": (20.752, 0.022, 3.770),
    "III": (21.143, 0.000, 0.063),
    "IV": (10.0, 18.0, 6.0),
    "dynamic": (19.01, -4.69, 0.02),
}
GAPS = {  # x, y, z, psi: RMSE of the transformation by yaw alone on noise-free velocities, of the prototype
    "I": (0.002, 0.001, 0.061, 0.0005),
    "II": (0.164, 0.011, 2.28, 0.001),
    "III": (0.001, 0.000, 0.050, 0.0001),
    "IV": (0.497, 0.168, 3.73, 0.046),
    "dynamic": (0.102, 0.024, 0.360, 0.008),
}


@pytest.mark.parametrize("name", PATHS)
def test_paths_end_where_they_should_and_yaw_alone_leads_elsewhere(name):
    states = noise_free("vehicle", PATHS[name].inputs())
    np.testing.assert_allclose(states[-1, 9:], ENDS[name], atol=6e-3)
    pose = states[:, [9, 10, 11, 8]]
    gap = np.sqrt(np.square(planar_pose(states[None, :, :6], DT)[0] - pose).mean(axis=0))
    np.testing.assert_allclose(gap, GAPS[name], rtol=0.02, atol=6e-4)
    # The full transformation of exact velocities is the exact pose, with roll and pitch told or reckoned.
    for attitude in (states[None, :, 6:8], None):
        np.testing.assert_allclose(full_pose(states[None, :, :6], attitude, DT)[0], pose, atol=2e-5)
    np.testing.assert_allclose(reckoned_attitude(states[None, :, :6], DT)[0], states[:, 6:8], atol=1e-6)


def test_inputs_of_the_dynamic_path_change_sign_as_the_sines_do():
    inputs, time = PATHS["dynamic"].inputs(), DT * np.arange(25000)
    np.testing.assert_array_equal(inputs[:, 2] > 0, (time % 14.0) < 7.0)
    np.testing.assert_array_equal(inputs[:, 3] > 0, (time % 10.0) < 5.0)
    np.testing.assert_allclose(np.unique(inputs[:, 0]), 2.84531 * np.array([0.6, 1.4]))
    np.testing.assert_allclose(inputs[:, 1], -0.006 * inputs[:, 0])
    with pytest.raises(ValueError, match="path must be one of I, II, III, IV, dynamic, but got 'V'"):
        find_path("V")


def test_measurements_alone_are_what_the_sensors_say():
    truth = true_runs("vehicle", keys_of("III", 2, 0), PATHS["III"].inputs(400))
    velocities = measured_velocities(truth)
    np.testing.assert_array_equal(velocities[..., [0, 1, 2, 5]], truth.measurements)
    assert not velocities[..., 3:5].any()
    errors = (velocities - truth.states[..., :6])[..., [0, 1, 2, 5]]
    np.testing.assert_allclose(errors.std(axis=(0, 1)), 1e-3, rtol=0.1)
    scores = scores_of(measured(), truth, keys_of("III", 2, 0), PATHS["III"].inputs(400))
    assert np.isnan(scores.full).all() and np.isnan(scores.nees).all() and np.isfinite(scores.planar).all()


def test_bound_of_measured_velocities_is_the_golden_ratio():
    _, _, outside, bound = along_path("vehicle", PATHS["IV"].inputs(600))
    np.testing.assert_allclose(bound.velocities[[0, 1, 2, 5]], GOLDEN, rtol=1e-3)
    assert (bound.velocities[3:5] > 2 * GOLDEN).all() and outside[-1] >= outside[:-1].max()


def test_mean_propagating_filter_has_half_the_innovation_as_gain():
    # A forecast that is f(mean) plus noise has the covariance Q whatever came before: an oracle for many members.
    model = papers_model("motion")
    inputs, keys = for_all(PATHS["I"].inputs(60), 2), keys_of("I", 2, 0)
    z = simulate(model, keys, inputs).measurements
    found = run(MeanPropagatingEnKF(model=model, ensemble_size=4000), keys, inputs, z).means
    mean, cov, h = model.prior_mean, model.prior_cov, np.eye(8)[[0, 1, 2, 5]]
    for k in range(61):
        if k > 0:
            mean = np.array(model.transition(tuple(mean), tuple(inputs[0, k - 1]), model.constants))
            cov = model.process_noise_cov
        mean, _, _ = kalman_update(mean, cov, z[0, k] - h @ mean, h, model.measurement_noise_cov)
        np.testing.assert_allclose(found[0, k, :6], mean[:6], atol=2e-4)
    right = run(EnsembleKalmanFilter(model=model, ensemble_size=4000), keys, inputs, z).means
    assert np.abs(found - right).max() > 3e-4


def test_mean_propagating_filter_has_two_thirds_of_the_noise():
    model = papers_model("motion")
    inputs, keys = for_all(PATHS["I"].inputs(500), 4), keys_of("I", 4, 0)
    truth = simulate(model, keys, inputs)
    for kind, expected in ((MeanPropagatingEnKF, MEAN_ONLY), (EnsembleKalmanFilter, GOLDEN)):
        filter_ = kind(model=model, ensemble_size=500)
        errors = (run(filter_, keys, inputs, truth.measurements).means - truth.states)[:, 50:, [0, 1, 2, 5]]
        assert np.sqrt(np.square(errors).mean()) == pytest.approx(expected, rel=0.02)


def test_own_attitude_is_what_its_own_rates_lead_to():
    own = kalman()[3].filter
    inputs, keys = np.zeros((2, 300, 6)), keys_of("dynamic", 2, 0)
    inputs[..., :4] = PATHS["dynamic"].inputs(300)
    z = true_runs("vehicle", keys, inputs[0, :, :4]).measurements
    means = run(own, keys, inputs, z).means
    told = inputs.copy()
    told[..., 4:] = reckoned_attitude(means, DT)[:, :-1]
    plain = run(ExtendedKalmanFilter(model=own.model), keys, told, z).means
    np.testing.assert_allclose(means, plain, atol=1e-13)
    inputs[..., 4:] = 0.3  # what is given as roll and pitch does not matter
    np.testing.assert_array_equal(run(own, keys, inputs, z).means, means)


def test_filters_on_the_same_runs():
    ekf8, _, level, own = kalman()
    (result,) = run_tasks([Task("dynamic", "vehicle", [measured(), ekf8, level, own])], runs=5, steps=3000)
    scores = result.scores
    assert [len(one.nees) for one in scores.values()] == [5] * 4
    for label in ("EKF8", "EKF6 level", "EKF6 own attitude"):
        rmse = scores[label].rmse("velocities")[[0, 1, 2, 5]]
        np.testing.assert_allclose(rmse, GOLDEN, rtol=0.05)  # 5000 steps of one run after another
        np.testing.assert_allclose(scores[label].rmse("planar"), scores["EKF8"].rmse("planar"), rtol=0.1)
    assert 6 < scores["EKF8"].nees.mean() < 10 and scores["EKF6 level"].nees.mean() > 30
    assert (scores["EKF6 level"].rmse("velocities")[3:5] > 4 * scores["EKF8"].rmse("velocities")[3:5]).any()
    again = run_tasks([Task("dynamic", "vehicle", [ekf8])], runs=5, steps=3000)[0].scores["EKF8"]
    np.testing.assert_array_equal(again.velocities, scores["EKF8"].velocities)


def test_corners_of_the_bounds_are_unstable():
    count, growth = unstable_corners()
    assert count == 23 and growth == pytest.approx(1.77, abs=0.01)


def test_printed_tables_are_whole():
    assert set(PAPERS) == set(VEHICLE_STUDIES)
    assert set(ngatini2017.PATHS) == set(PATHS) and list(ngatini2019.TABLE_III) == [50, 100, 200, 300]
    assert [len(row.rmse) for row in ngatini2019.TABLE_III.values()] == [4] * 4
    fourth = ngatini2017.PATHS["IV"].enkf.rmse
    for name, value in ngatini2019.TABLE_III[50].rmse.items():
        assert fourth[name] == pytest.approx(value, abs=5e-4)  # one run of the two papers is the same
    for path in ngatini2017.PATHS.values():
        assert set(path.enkf.rmse) == set(path.fkf.rmse) and set(path.enkf.final_percent) == set(
            path.fkf.final_percent
        )
    dynamic = ngatini2017.PATHS["dynamic"]
    assert dynamic.enkf.final_percent == dynamic.enkf.rmse and dynamic.remark


def test_why_differences_are_told_by_size():
    (result,) = run_tasks([Task("III", "vehicle", [measured(), kalman()[0]])], runs=2, steps=400)
    scores = result.scores["EKF8"]
    pose = dict(zip(("x", "y", "psi"), scores.rmse("full")[[0, 1, 3]], strict=True))
    full = why_different(PrintedRow(pose, 1.0), scores, result)
    assert full == "of the size of ours by the full transformation"
    tiny = why_different(PrintedRow({"psi": 1e-3 * result.bound.pose[3]}, 1.0), scores, result)
    assert "psi far below the bound" in tiny
    huge = why_different(PrintedRow({"x": 1e3, "psi": pose["psi"]}, 1.0), scores, result)
    assert "x of no size of ours" in huge and "psi of the size" in huge


def test_digits_stand_apart_by_thousands():
    assert [digits(one) for one in (0.78612, 12.34, 8.0, 45421.0, float("nan"))] == [
        "0.786",
        "12.3",
        "8",
        "45 400",
        "",
    ]
