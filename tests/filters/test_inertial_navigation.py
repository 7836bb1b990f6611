"""An IMU with GPS and a barometer: errors of a simulated flight have the stated covariance."""

import numpy as np
import pytest

import filters
from filters.logs.findings import is_sparse
from filters.named import model_named
from thruster_env.model import poses, rotations
from thruster_env.model.turns import difference

DT, ROWS, RUNS = 0.02, 1500, 24


def flight(rng):
    """True states, inputs and measurements of turns with changing forces, by the sensors' own equations."""
    t = DT * np.arange(ROWS)
    rates = np.column_stack([0.1 * np.sin(0.3 * t), 0.08 * np.cos(0.2 * t), 0.25 + 0.1 * np.sin(0.1 * t)])
    forces = np.column_stack([np.sin(0.25 * t), 0.5 * np.cos(0.4 * t), 9.81 + 0.3 * np.sin(0.5 * t)])
    turn = rotations.exponential(np.deg2rad([2.0, 2.0, 5.0]) * rng.normal(size=3))
    x = np.array([*turn, *(5.0 * rng.normal(size=3)), *(4.5 * rng.normal(size=3))])
    bias = rng.normal(size=7) * [*[0.005] * 3, *[0.05] * 3, 20.0]
    walk = np.sqrt(DT) * np.array([*[1e-5] * 3, *[1e-4] * 3, 0.02])
    states, inputs = [], []
    for rate, force in zip(rates, forces, strict=True):
        states.append([*x, *bias])
        noise = rng.normal(size=6) * np.repeat([2e-4, 2e-3], 3) / np.sqrt(DT)
        inputs.append([*rate, *force] + bias[:6] + noise)
        x = np.array(poses.strapdown(x, rate, force, (0.0, 0.0, -9.81), DT))
        bias = bias + walk * rng.normal(size=7)
    states = np.array(states)
    heights = states[:, 9:10] + states[:, 16:] + 0.3 * rng.normal(size=(ROWS, 1))
    z = np.hstack([states[:, 7:10] + 1.5 * rng.normal(size=(ROWS, 3)), heights])
    z[np.arange(ROWS) % 10 != 0, :3], z[np.arange(ROWS) % 5 != 0, 3] = np.nan, np.nan
    return states, np.array(inputs)[:-1], z


@pytest.fixture(scope="module")
def model():
    return model_named("inertial-navigation")(dt=DT)


def test_errors_have_the_stated_covariance(model):
    """NEES of 16 within four deviations of its mean over runs, with a tenth for linearisation."""
    rng = np.random.default_rng(0)
    states, inputs, z = (np.array(part) for part in zip(*(flight(rng) for _ in range(RUNS)), strict=True))
    estimates = filters.run(filters.make_filter("ekf", model), inputs=inputs, measurements=z)
    for row, yaw in ((100, 6.0), (-1, 2.0)):
        errors = np.array(
            [
                difference(list(a[row]), list(b[row]), model.turns)
                for a, b in zip(states, estimates.means, strict=True)
            ]
        )
        covs = estimates.covs[:, row]
        nees = np.einsum("ri,ri->r", errors, np.linalg.solve(covs, errors[..., None])[..., 0]).mean()
        assert 16.0 - 4.0 * np.sqrt(32.0 / RUNS) < nees < 17.6 + 4.0 * np.sqrt(32.0 / RUNS)
        assert np.rad2deg(np.sqrt((errors[:, 2] ** 2).mean())) < yaw
        assert np.sqrt((errors[:, 6:9] ** 2).mean()) < 1.5  # of one position of GPS


def test_the_noise_is_that_of_white_sensors_and_walking_biases(model):
    """Closed forms of a step: angle, velocity and position; errors of biases move them by minus dt."""
    q, walk = model.process_noise_cov, 1e-4**2
    assert q[0, 0] == pytest.approx(2e-4**2 * DT + 1e-5**2 * DT**3 / 3.0)
    assert q[3, 3] == pytest.approx(2e-3**2 * DT + walk * DT**3 / 3.0)
    assert q[6, 6] == pytest.approx(2e-3**2 * DT**3 / 3.0 + walk * DT**5 / 20.0)
    assert q[3, 12] == pytest.approx(-walk * DT**2 / 2.0) and q[3, 4] == 0.0
    assert np.linalg.eigvalsh(q).min() > 0.0
    turned = model_named("inertial-navigation:heading=90")(dt=DT).prior_mean[:4]
    np.testing.assert_allclose(rotations.to_world(turned, (1.0, 0.0, 0.0)), (0.0, 1.0, 0.0), atol=1e-15)


def test_innovations_of_slow_sensors_are_drawn_as_dots(model):
    """A line between rows without a neighbour has no length."""
    _, inputs, z = flight(np.random.default_rng(1))
    figure = filters.run(filters.make_filter("ekf", model), inputs=inputs[:200], measurements=z[:201]).plot()
    lines = [line for axis in figure.axes for line in axis.lines if line.get_label() == "innovation"]
    assert [(line.get_marker(), len(line.get_xdata())) for line in lines] == [(".", 21)] * 3 + [(".", 41)]
    for measured, sparse in ((np.array([True] * 9 + [False]), False), (np.arange(12) % 3 == 0, True)):
        assert is_sparse(measured) is sparse
