"""`filters.run` and `smooth` of plain arrays: tables and pictures, a prediction first, and steps of any length."""

import numpy as np
import pandas
import pytest

import filters
from filters.models import kalman_filter
from filters.plants import pendulum

rng = np.random.default_rng(3)
Z = np.cumsum(rng.normal(size=30))
LEVEL = kalman_filter("constant-velocity", dt=0.1, noise=1.0, acceleration=1.0)
PLANT, DT = pendulum(), 0.05
LENGTHS, U = rng.uniform(0.02, 0.13, 29), rng.normal(size=29)


def test_a_run_of_a_list_a_table_or_a_batch_is_a_table_and_a_picture(as_python):
    estimates = filters.run(LEVEL, Z.tolist(), dt=0.1)
    table = estimates.to_frame()
    assert table.index.name == "time_s" and table.index[2] == pytest.approx(0.2)
    np.testing.assert_array_equal(table["position"], estimates.means[:, 0])
    np.testing.assert_array_equal(table["std_velocity_1_per_s"], estimates.stds[:, 1])
    labels = [axis.get_ylabel() for axis in estimates.plot().axes]
    assert len(labels) == 3 and labels[2] == "innovation of\nz"
    batch = filters.run(LEVEL, np.stack([0 * Z, Z])[..., None], dt=0.1)
    pandas.testing.assert_frame_equal(batch.to_frame(1), table)
    of_pandas = filters.run(LEVEL, pandas.DataFrame({"z": Z}))
    np.testing.assert_array_equal(of_pandas.means, estimates.means)
    with pytest.raises(ValueError, match="run must be at most 1, but got 2"):
        batch.plot(2)


def test_a_prediction_before_the_first_measurement_is_that_of_the_prior(as_python):
    model = LEVEL.model
    a = model.matrices()[0]
    predicted = model.replace(
        prior_mean=a @ model.prior_mean, prior_cov=a @ model.prior_cov @ a.T + model.process_noise_cov
    )
    for function in (filters.run, filters.smooth):
        after = function(filters.make_filter("kf", predicted), Z)
        late = function(LEVEL, Z, update_first=False)
        np.testing.assert_allclose(late.means, after.means, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(late.covs, after.covs, rtol=1e-9)


@pytest.mark.parametrize("noise", [None, PLANT.noise])
def test_steps_of_any_length_are_those_of_a_live_filter(noise):
    filter_ = filters.make_filter("ekf", PLANT.at(DT))
    arguments = {"inputs": U, "measurements": 0.1 * Z, "dt": LENGTHS, "noise": noise}
    estimates = filters.run(filter_, **arguments)
    live, times = filter_.live(noise=noise), np.cumsum(LENGTHS)
    live.start(0.0, 0.1 * Z[:1])
    for time, u, z in zip(times.tolist(), U, Z[1:], strict=True):
        live.predict_to(time, [u])
        live.update(time, None, [0.1 * z])
    np.testing.assert_allclose(estimates.means[-1], live.mean, rtol=1e-9)
    np.testing.assert_allclose(estimates.covs[-1], live.cov, rtol=1e-9)
    np.testing.assert_allclose(estimates.to_frame().index[1:], times, rtol=1e-12)
    smoothed = filters.smooth(filter_, **arguments)
    np.testing.assert_allclose(smoothed.means[-1], live.mean, rtol=1e-9)
    if noise is None:
        np.testing.assert_allclose(smoothed.means, by_hand(filter_, estimates), rtol=1e-6, atol=1e-9)


def by_hand(filter_, estimates):
    """Rauch, Tung, Striebel over parts of steps, each with its own F and Q in proportion to its length."""
    plain, counts = filter_.model, np.ceil(LENGTHS / DT - 1e-9).astype(int)
    parts, u = np.repeat(LENGTHS / counts, counts), np.repeat(U, counts)
    rows = np.append(0, np.cumsum(counts))
    means, covs, linear = [estimates.means[0]], [estimates.covs[0]], []
    for k, (length, input_) in enumerate(zip(parts.tolist(), u.tolist(), strict=True)):
        model = PLANT.at(length, plain.substeps)
        slopes, b, offset, *_ = filters.linearize(model, means[-1], [input_]).matrices()
        mean = slopes @ means[-1] + b @ [input_] + offset
        cov = slopes @ covs[-1] @ slopes.T + plain.process_noise_cov * length / DT
        linear.append((slopes, mean, cov))
        at = np.flatnonzero(rows == k + 1)
        means.append(estimates.means[at[0]] if at.size else mean)
        covs.append(estimates.covs[at[0]] if at.size else cov)
    later, out = means[-1], [means[-1]]
    for k in reversed(range(len(parts))):
        slopes, mean, cov = linear[k]
        later = means[k] + covs[k] @ slopes.T @ np.linalg.solve(cov, later - mean)
        out.append(later)
    return np.array(out[::-1])[rows]


def test_what_steps_of_different_lengths_need_is_said():
    with pytest.raises(ValueError, match="whose sample time is a constant, .* but got 'kf'"):
        filters.run(LEVEL, Z, dt=LENGTHS)
    with pytest.raises(ValueError, match="or of 29 steps, positive and finite, but got"):
        filters.run(LEVEL, Z, dt=[0.1, 0.2])
    ekf = filters.make_filter("ekf", PLANT.at(DT))
    with pytest.raises(ValueError, match="lag must be left out where steps are longer"):
        filters.smooth(ekf, inputs=U, measurements=Z, dt=LENGTHS, lag=2)
    with pytest.raises(ValueError, match="noise must come with dt"):
        filters.run(ekf, inputs=U, measurements=Z, noise=PLANT.noise)
