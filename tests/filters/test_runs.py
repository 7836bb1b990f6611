"""`filters.run` and `smooth` of plain arrays: tables and pictures, a prediction first, and steps of any length."""

import numpy as np
import pandas
import pytest
from scipy.linalg import expm

import filters
from filters.named import model_named
from filters.plants import pendulum
from tests.filters.checks import refused
from tests.filters.test_live import A, oscillator
from tests.oracles import each_close, each_equal

rng = np.random.default_rng(3)
Z = np.cumsum(rng.normal(size=30))
LEVEL = filters.make_filter("kf", model_named("constant-velocity:acceleration=1,R=1")(dt=0.1))
PLANT, DT = pendulum(), 0.05
LENGTHS, U = rng.uniform(0.02, 0.13, 29), rng.normal(size=29)
OSCILLATOR = oscillator(operating_state=[0.0, 0.0], operating_input=[0.0])
LINEAR, MEASURED = OSCILLATOR.at(DT, substeps=4), rng.normal(size=(30, 2))
MEASURED[4], MEASURED[7, 0] = np.nan, np.nan


def test_a_run_of_a_list_a_table_or_a_batch_is_a_table_and_a_picture(as_python):
    estimates = filters.run(LEVEL, Z.tolist(), dt=0.1)
    table = estimates.to_frame()
    assert table.index.name == "time_s" and table.index[2] == pytest.approx(0.2)
    each_equal((table["position"], table["std_velocity_1_per_s"]), (estimates.means[:, 0], estimates.stds[:, 1]))
    labels = [axis.get_ylabel() for axis in estimates.plot().axes]
    assert len(labels) == 3 and labels[2] == "innovation of\nz"
    smoothed = filters.smooth(LEVEL, Z.tolist(), dt=0.1)
    of_smoother = smoothed.to_frame()
    each_equal((of_smoother["position"], of_smoother["std_position"]), (smoothed.means[:, 0], smoothed.stds[:, 0]))
    assert (of_smoother["innovation_z"] == table["innovation_z"]).all() and len(smoothed.plot().axes) == 3
    batch = filters.run(LEVEL, np.stack([0 * Z, Z])[..., None], dt=0.1)
    pandas.testing.assert_frame_equal(batch.to_frame(1), table)
    of_pandas = filters.run(LEVEL, pandas.DataFrame({"z": Z}))
    np.testing.assert_array_equal(of_pandas.means, estimates.means)
    refused("run must be at most 1, but got 2", batch.plot, 2)
    with pytest.raises(ValueError, match="at least 3 rows, but run has 1"):
        filters.run(LEVEL, Z[:1]).to_frame()


def test_columns_of_a_table_in_another_order_than_the_models_are_refused():
    kf, swapped = filters.make_filter("kf", LINEAR), pandas.DataFrame(MEASURED, columns=["rate", "position"])
    rule = r"position, rate, but got rate, position: table\[\['position', 'rate'\]\]"
    refused(rule, filters.run, kf, inputs=U, measurements=swapped)
    named = filters.run(kf, inputs=U, measurements=swapped[["position", "rate"]])
    plain = filters.run(kf, inputs=U, measurements=MEASURED[:, ::-1])
    np.testing.assert_array_equal(named.means, plain.means)


@pytest.mark.parametrize("lengths", [None, LENGTHS])
def test_covariances_of_fewer_rows_are_refused_also_with_steps_of_any_length(lengths):
    kf = filters.make_filter("kf", LINEAR)
    for name, size in (("process_noise_covs", 29), ("measurement_noise_covs", 30)):
        for covs in (np.eye(2), np.eye(2)[None], np.tile(np.eye(2), (size - 1, 1, 1)), np.ones((size, 2))):
            with pytest.raises(ValueError, match=rf"{name} must have shape \({size}, 2, 2\), but got"):
                filters.run(kf, inputs=U, measurements=MEASURED, dt=lengths, **{name: covs})


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
    each_close((estimates.means[-1], estimates.covs[-1]), (live.mean, live.cov), rtol=1e-9)
    np.testing.assert_allclose(estimates.to_frame().index[1:], times, rtol=1e-12)
    smoothed = filters.smooth(filter_, **arguments)
    np.testing.assert_allclose(smoothed.means[-1], live.mean, rtol=1e-9)
    if noise is None:
        np.testing.assert_allclose(smoothed.means, by_hand(filter_, estimates), rtol=1e-6, atol=1e-9)


def normal_posterior(q_of_length):
    """Mean and covariance of all states of the oscillator, (K + 1, 2), from their joint normal distribution."""
    f, b, times = [], [], np.append(0.0, np.cumsum(LENGTHS))
    slope = np.zeros((3, 3))
    slope[:2, :2], slope[1, 2] = A, 1.0
    for length in LENGTHS.tolist():
        moved = expm(slope * length)
        f, b = [*f, moved[:2, :2]], [*b, moved[:2, 2]]
    mean, cov = [np.array([0.5, 0.0])], np.zeros((2 * len(times), 2 * len(times)))
    cov[:2, :2] = np.diag([0.3, 0.2])
    for k, length in enumerate(LENGTHS.tolist()):
        at, last = slice(2 * k + 2, 2 * k + 4), slice(2 * k, 2 * k + 2)
        mean.append(f[k] @ mean[-1] + b[k] * U[k])
        cov[at, : 2 * k + 2] = f[k] @ cov[last, : 2 * k + 2]
        cov[: 2 * k + 2, at] = cov[at, : 2 * k + 2].T
        cov[at, at] = f[k] @ cov[last, last] @ f[k].T + q_of_length(length)
    mean, measured = np.concatenate(mean), np.flatnonzero(~np.isnan(MEASURED.ravel()))
    s = cov[np.ix_(measured, measured)] + np.diag(np.tile([0.02, 0.1], len(times))[measured])
    gain = np.linalg.solve(s, cov[measured]).T
    return (mean + gain @ (MEASURED.ravel() - mean)[measured]).reshape(-1, 2), cov - gain @ cov[measured]


def test_a_kalman_filter_in_steps_of_any_length_is_exact_and_smooths_late_samples_as_those_in_time():
    kf = filters.make_filter("kf", LINEAR)
    data: dict = {"inputs": U, "measurements": MEASURED, "dt": LENGTHS, "noise": OSCILLATOR.noise}
    mean, cov = normal_posterior(OSCILLATOR.noise)
    smoothed, estimates = filters.smooth(kf, **data), filters.run(kf, **data)
    np.testing.assert_allclose(smoothed.means, mean, rtol=1e-6, atol=1e-7)
    for k in range(len(mean)):
        block = slice(2 * k, 2 * k + 2)
        np.testing.assert_allclose(smoothed.covs[k], cov[block, block], rtol=1e-5, atol=1e-9)
    np.testing.assert_array_equal(filters.smooth(kf, **data, lag=0).means, estimates.means)
    lagged, times = filters.smooth(kf, **data, lag=3), np.append(0.0, np.cumsum(LENGTHS))
    in_time, late = (kf.live(noise=OSCILLATOR.noise, late=5.0) for _ in range(2))
    for live in (in_time, late):
        live.start(0.0, MEASURED[0])
    for k, (u, z) in enumerate(zip(U, MEASURED[1:], strict=True)):
        in_time.predict_to(times[k + 1], [u])
        in_time.update(times[k + 1], None, z)
        late.predict_to(times[k + 1], [u])
        if k % 2:
            late.update(times[k + 1], None, z)
            late.update(times[k], None, MEASURED[k])
        elif k == len(U) - 1:
            late.update(times[k + 1], None, z)
        if k >= 2:
            np.testing.assert_allclose(
                in_time.smoothed(times[k - 2])[0], lagged.means[k - 2], rtol=1e-7, atol=1e-9
            )
    np.testing.assert_allclose(in_time.mean, estimates.means[-1], rtol=1e-8)
    np.testing.assert_allclose(late.smoothed(times[9])[1], smoothed.covs[9], rtol=1e-7, atol=1e-12)
    between = 0.5 * (times[9] + times[10])
    parts, rows = np.insert(LENGTHS, 9, 0.5 * LENGTHS[9]), np.insert(MEASURED, 10, np.nan, axis=0)
    parts[10] *= 0.5
    data |= {"dt": parts, "inputs": np.insert(U, 9, U[9]), "measurements": rows}
    np.testing.assert_allclose(late.smoothed(between)[0], filters.smooth(kf, **data).means[10], rtol=1e-7)
    refused("time must be within late = 5 s before the belief, 0 to .* but got -1", late.smoothed, -1.0)


@pytest.mark.parametrize("name", ["imm", "mmae"])
def test_modes_in_steps_of_any_length_are_those_of_a_live_filter_and_alike_they_are_one(name, as_python):
    data: dict = {"inputs": U[:9], "measurements": MEASURED[:10], "dt": LENGTHS[:9]}
    imm = filters.make_filter(name, LINEAR, modes=[{}, {"process_noise_cov": 9.0 * LINEAR.process_noise_cov}])
    estimates, live, times = filters.run(imm, **data), imm.live(), np.cumsum(LENGTHS)
    live.start(0.0, MEASURED[0])
    for time, u, z in zip(times[:9].tolist(), U, MEASURED[1:], strict=False):
        live.predict_to(time, [u])
        live.update(time, None, z)
    each_close((live.mean, live.cov), (estimates.means[-1], estimates.covs[-1]), rtol=1e-9)
    alike, kf = (
        filters.make_filter(name, LINEAR, modes=[{}, {}], mode_filter="kf"),
        filters.make_filter("kf", LINEAR),
    )
    for function in (filters.run, filters.smooth):
        both = function(alike, **data), function(kf, **data)
        np.testing.assert_allclose(both[0].means, both[1].means, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(both[0].covs, both[1].covs, rtol=1e-7, atol=1e-12)
    if name == "imm":
        for arguments in ({}, {"transition": [[0.9, 0.1], [0.3, 0.7]]}):
            filter_ = filters.make_filter("imm", LINEAR, **arguments)
            half = filter_.of_length(0.5 * DT).transition_matrix
            np.testing.assert_allclose(half @ half, filter_.transition_matrix, rtol=1e-9)


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
    refused("whose sample time is a constant, .* but got 'kf'", filters.run, LEVEL, Z, dt=LENGTHS)
    refused("or of 29 steps, positive and finite, but got", filters.run, LEVEL, Z, dt=[0.1, 0.2])
    ekf = filters.make_filter("ekf", PLANT.at(DT))
    imm = filters.make_filter("imm", PLANT.at(DT))
    with pytest.raises(ValueError, match="of the filter 'imm' cannot vary .* but got another Q"):
        filters.run(imm, inputs=U, measurements=Z, dt=LENGTHS, noise=PLANT.noise)
    refused("of the filter 'imm' cannot vary .* but got another Q", imm.live, noise=PLANT.noise)
    cycle = filters.make_filter("imm", PLANT.at(DT), transition=[[0.1, 0.9], [0.9, 0.1]])
    with pytest.raises(ValueError, match="transition must be that of a chain in continuous time"):
        filters.run(cycle, inputs=U, measurements=Z, dt=LENGTHS)
    with pytest.raises(ValueError, match="in continuous time|of one sample time|sample time is a constant"):
        filters.run(filters.make_filter("kf-steady", LINEAR), inputs=U, measurements=MEASURED, dt=LENGTHS)
    refused("noise must come with dt", filters.run, ekf, inputs=U, measurements=Z, noise=PLANT.noise)
