"""Particles, modes, parts of a mixture and windows that turn: about one axis they are those of an angle."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation as Turned

import filters
from tests.filters.attitudes import SENSOR, advance, attitude_model, directions, ran, simulated
from tests.filters.test_measured_rotations import is_at, left_jacobian, tracked, tracker_model
from tests.oracles import each_close
from thruster_env.core.compiled import interpreted
from thruster_env.model import rotations
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import Direction, Rotation, difference, move

DT = 0.1
KINDS = [
    ("pf", {}),
    ("pf", {"proposal": "optimal"}),
    ("pf", {"resampling": "gaussian", "resampling_threshold": 1.0}),
    ("pf", {"regularisation": 0.8}),
    ("pf", {"regularisation": 1.0, "smoothed": (2, 3)}),
    ("apf", {"regularisation": 0.5}),
    ("rbpf", {"sampled": (2,), "regularisation": 0.5}),
    ("rbpf", {"sampled": (3,)}),
    ("rbpf", {"sampled": (0, 1, 2, 3)}),
    ("imm", {}),
    ("imm", {"mode_filter": "ukf"}),
    ("mmae", {}),
    ("gsf", {"component": 2, "parts": 7}),
    ("mhe", {"horizon": 3, "iterations": 4}),
    ("mhe", {"horizon": 2, "loss": "student"}),
]


def heading_model(turns):
    """A heading, whose rate is the input less a bias, as a rotation that stays level or as three angles."""

    def turn(x, u, c):
        return *rotations.product(x[:4], rotations.exponential((0.0, 0.0, (u[0] - x[4]) * DT))), x[4]

    exact = 1e-12**2
    return StateSpaceModel(
        transition=turn if turns else lambda x, u, c: (x[0], x[1], x[2] + (u[0] - x[3]) * DT, x[3]),
        observe=(lambda x, c: x[:4]) if turns else lambda x, c: x[:3],
        process_noise_cov=[0.0, 0.0, 0.05**2, 0.02**2],
        measurement_noise_cov=[exact, exact, 0.2**2],
        prior_mean=[1.0, 0.0, 0.0, 0.0, 0.1] if turns else [0.0, 0.0, 0.0, 0.1],
        prior_cov=[0.0, 0.0, 0.4**2, 0.1**2],
        states=(Rotation("attitude"), "bias") if turns else ("x", "y", "heading", "bias"),
        measurements=(Rotation("compass", "m"),) if turns else ("m_x", "m_y", "m_z"),
        inputs=1,
    )


def headings():
    """Inputs (4, 1) and measured headings (5, 3), of which one is missing."""
    draw = np.random.default_rng(5).normal
    z = np.zeros((5, 3))
    z[:, 2] = 0.3 + 0.08 * np.arange(5) + 0.2 * draw(size=5)
    z[2] = np.nan
    return np.full((4, 1), 0.8), z


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize(("name", "parameters"), KINDS)
def test_about_one_axis_a_rotation_is_an_angle(name, parameters):
    """With the same draws: means, covariances, innovations and likelihoods, of a state and a measurement."""
    inputs, z = headings()
    quaternions = np.array([rotations.exponential(row) for row in z])
    size = {"ensemble_size": 24} if name in ("pf", "apf", "rbpf") else {}
    turning, plain = (
        filters.run(
            filters.make_filter(name, heading_model(turns), **parameters, **size),
            keys=np.array([[3, 4]]),
            inputs=inputs[None],
            measurements=measured[None],
        )
        for turns, measured in ((True, quaternions), (False, z))
    )
    heading = 2.0 * np.arctan2(turning.means[..., 3], turning.means[..., 0])
    each_close((heading, turning.means[..., 4]), (plain.means[..., 2], plain.means[..., 3]), atol=1e-11)
    each_close((turning.covs, turning.innovations), (plain.covs, plain.innovations), atol=1e-11)
    np.testing.assert_allclose(turning.innovation_covs, plain.innovation_covs, atol=1e-11)
    np.testing.assert_allclose(turning.log_likelihoods, plain.log_likelihoods, atol=1e-8)


def test_particles_have_an_intrinsic_mean_and_the_estimate_of_the_extended_filter():
    """Of a thousand: their mean is where their errors have none, and the filter is that of small errors."""
    sensor = np.array([0.1, 0.15, 0.2])
    gyro, z = tracked(sensor=sensor)
    model = tracker_model(sensor=sensor)
    particle = filters.make_filter("pf", model, resampling="gaussian")
    belief, _ = particle.update(particle.init((1, 2)), z[0])
    errors = np.array(difference(belief.members[:7], belief.mean, model.turns))
    w = np.exp(belief.members[7])
    np.testing.assert_allclose(errors @ w, 0.0, atol=1e-9)
    np.testing.assert_allclose((errors * w) @ errors.T / (1.0 - w @ w), belief.cov, atol=1e-9)
    estimates, exact = (
        filters.run(filters.make_filter(name, model, **more), inputs=gyro, measurements=z)
        for name, more in (("pf", {"resampling": "gaussian"}), ("ekf", {}))
    )
    off = np.array([difference(a, b, model.turns) for a, b in zip(estimates.means, exact.means, strict=True)])
    assert (np.abs(off) < exact.stds).all()
    assert np.abs(np.log(estimates.stds[-1] / exact.stds[-1])).max() < 0.3
    assert estimates.log_likelihoods.sum() == pytest.approx(exact.log_likelihoods.sum(), abs=2.0)


@pytest.mark.usefixtures("as_python")
def test_particles_from_far_away_weigh_the_exact_difference():
    """A prior of 100 degrees: the weights are N(log(q^-1 z); 0, R) of each particle."""
    model = tracker_model(degrees=100.0, sensor=np.array([0.3, 0.5, 0.8]))
    filter_ = filters.make_filter("pf", model, ensemble_size=40)
    z = rotations.exponential((0.7, -1.2, 0.4))
    before = filter_.init((5, 6))
    belief, _ = filter_.update(before, np.array(z))
    q = Turned.from_quat(before.members[:4].T, scalar_first=True)
    v = (q.inv() * Turned.from_quat(z, scalar_first=True)).as_rotvec()
    logs = -0.5 * np.square(v / [0.3, 0.5, 0.8]).sum(axis=1)
    logs -= np.log(np.exp(logs - logs.max()).sum()) + logs.max()
    near = logs > -40.0
    np.testing.assert_allclose(belief.members[7][near], logs[near], atol=1e-10)


def test_the_noise_of_a_direction_cannot_be_taken_back():
    """So `apf` and the optimal proposal refuse directions; `pf` takes them."""
    model = StateSpaceModel(
        transition=lambda x, u, c: x,
        observe=lambda x, c: x,
        process_noise_cov=[0.1**2] * 2,
        measurement_noise_cov=[0.1**2] * 3,
        prior_mean=[0.0, 0.0, 1.0],
        prior_cov=[0.1**2] * 2,
        states=(Direction("field"),),
        measurements=tuple(Quantity(f"z {i}", f"z_{i}") for i in range(3)),
        inputs=0,
    )
    assert filters.make_filter("pf", model).takes_rotations
    for name, more in (("apf", {}), ("pf", {"proposal": "optimal"})):
        with pytest.raises(ValueError, match="'field' is of directions"):
            filters.make_filter(name, model, **more).kernels()


@pytest.mark.parametrize("name", ["imm", "gsf"])
def test_parts_of_a_mixture_are_merged_in_the_tangent_at_their_mean(name):
    """By scipy's rotations; compiled code is Python's."""
    gyro, z = tracked(40.0)
    filter_ = filters.make_filter(name, tracker_model(degrees=40.0), **({"parts": 7} if name == "gsf" else {}))
    estimates = filters.run(filter_, inputs=gyro[:3], measurements=z[:4])
    with interpreted():
        belief, _ = filter_.update(filter_.init(), z[0])
        in_python = filters.run(filter_, inputs=gyro[:3], measurements=z[:4])
    np.testing.assert_allclose(estimates.means, in_python.means, atol=1e-13)
    np.testing.assert_allclose(estimates.covs, in_python.covs, atol=1e-14)
    means, covs, weights = (filter_.mode_estimates if name == "imm" else filter_.part_estimates)(belief)
    turned, q = (
        Turned.from_quat(means[:, :4], scalar_first=True),
        Turned.from_quat(means[0, :4], scalar_first=True),
    )
    for _ in range(50):
        q = q * Turned.from_rotvec(weights @ (q.inv() * turned).as_rotvec())
    bias = weights @ means[:, 4:]
    d = np.hstack([(q.inv() * turned).as_rotvec(), means[:, 4:] - bias])
    cov = np.zeros((6, 6))
    for weight, part, off in zip(weights, covs, d, strict=True):
        J = np.eye(6)
        J[:3, :3] = np.linalg.inv(left_jacobian(-off[:3]))
        cov += weight * (J @ part @ J.T + np.outer(off, off))
    is_at(belief.mean, belief.cov, q, bias, cov)


@pytest.mark.usefixtures("as_python")
def test_a_moving_horizon_has_the_most_probable_attitudes():
    """Of four steps from 40 degrees: scipy's minimum of the cost.

    The side of the error hardly matters: P of the arrival is Gauss and Newton's, in which residuals turn with f.
    """
    _, gyro, z = (part[0] for part in simulated(1, 6, 40.0))
    model = attitude_model(degrees=40.0)
    filter_ = filters.make_filter("mhe", model, loss="quadratic", iterations=12)
    belief, _ = filter_.update(filter_.init(), z[0])
    for k in range(3):
        belief, _ = filter_.update(filter_.predict(belief, gyro[k]), z[k + 1])
    roots = [np.sqrt(np.diag(cov)) for cov in (model.prior_cov, model.process_noise_cov)]

    def residuals(d):
        x = [np.array(move(state, step, model.turns)) for state, step in zip(window, d.reshape(4, 6), strict=True)]
        parts = [np.array(difference(x[0], model.prior_mean, model.turns)) / roots[0]]
        parts += [(z[k] - directions(x[k], ())) / SENSOR for k in range(4)]
        ahead = (advance(x[k], gyro[k], model.constants) for k in range(3))
        parts += [
            np.array(difference(y, after, model.turns)) / roots[1] for y, after in zip(x[1:], ahead, strict=True)
        ]
        return np.concatenate(parts)

    window = filter_.window(belief)
    found = least_squares(residuals, np.zeros(24), "3-point", x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert np.abs(found.x).max() < 1e-7
    np.testing.assert_allclose(belief.cov, np.linalg.inv(found.jac.T @ found.jac)[18:, 18:], atol=1e-8)
    models = (attitude_model(side, degrees=40.0) for side in ("body", "world"))
    body, world = (ran(model, gyro, z, "mhe", horizon=2, iterations=8) for model in models)
    np.testing.assert_allclose(world.means, body.means, atol=1e-6)


def test_a_window_of_one_step_is_the_iterated_filter():
    """Compiled, of a measured rotation from 60 degrees, of which one misses a number."""
    gyro, z = tracked(60.0)
    z = z[:4].copy()
    z[2, 1] = np.nan
    model, numbers = tracker_model(degrees=60.0), {"horizon": 1, "loss": "quadratic", "iterations": 12}
    window = ran(model, gyro[:3], z, "mhe", **numbers)
    iterated = ran(model, gyro[:3], z, "iekf", iterations=12)
    each_close((window.means, window.covs), (iterated.means, iterated.covs), atol=1e-9)
    np.testing.assert_allclose(window.innovations, iterated.innovations, atol=1e-9)
    np.testing.assert_allclose(window.log_likelihoods, iterated.log_likelihoods, atol=1e-7)
