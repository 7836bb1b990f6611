"""Rates of states with rotations: Munthe-Kaas's steps, noise by the continuous density, and filters on them."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation as Turned

import filters
from thruster_env.core.compiled import interpreted
from thruster_env.model import poses, rotations
from thruster_env.model.continuous import ContinuousModel
from thruster_env.model.turns import Direction, Pose, Rotation, difference, move

GYRO, WALK, SENSOR = 2e-3, 2e-4, 0.05


class Constants(NamedTuple):
    substep: float = 1.0


def measured_rates(x, u, c):
    """The gyroscope less its bias, which is constant."""
    return u[0] - x[4], u[1] - x[5], u[2] - x[6], 0.0, 0.0, 0.0


def twisted_rates(x, u, c):
    """A body's angular rate that depends on attitude and on a number that grows."""
    a, b, g = rotations.to_body(x[:4], (0.3, 1.0, 0.5))
    return a + np.sin(x[4]), b * x[4], 2.0 * g, 1.0


def same_in_the_world(x, u, c):
    """The same rate in the axes of the world."""
    *rate, growth = twisted_rates(x, u, c)
    return *rotations.to_world(x[:4], rate), growth


def directions(x, c):
    """Gravity and a magnetic field in the axes of the body."""
    return *rotations.to_body(x[:4], (0.0, 0.0, 1.0)), *rotations.to_body(x[:4], (0.0, 0.6, -0.8))


def gyroscope(rate=(0.0, 0.0, 0.0)):
    """An attitude by a gyroscope with a bias, in continuous time."""
    return ContinuousModel(
        rates=measured_rates,
        observe=directions,
        densities=[GYRO**2] * 3 + [WALK**2] * 3,
        constants=Constants(),
        arguments={
            "states": (Rotation("attitude"), "b_x", "b_y", "b_z"),
            "prior_mean": [1.0] + [0.0] * 6,
            "prior_cov": [0.1**2] * 3 + [0.02**2] * 3,
            "measurement_noise_cov": [SENSOR**2] * 6,
            "input_quantities": ("w_x", "w_y", "w_z"),
            "operating_input": rate,
        },
    )


def twisted(side):
    """A rotation whose rate depends on it."""
    return ContinuousModel(
        rates=twisted_rates if side == "body" else same_in_the_world,
        observe=directions,
        densities=[1e-4] * 4,
        constants=Constants(),
        arguments={
            "states": (Rotation("attitude", side=side), "s"),
            "prior_mean": [0.5, 0.5, -0.5, 0.5, 0.2],
            "prior_cov": [1e-4] * 4,
            "measurement_noise_cov": [1.0] * 6,
        },
    )


def propagated(plant, dt, substeps):
    """The state after a step in some equal parts."""
    x, u = plant.point
    for _ in range(substeps):
        x = plant.transition(x, u, Constants(dt / substeps))
    return x


def test_a_constant_rate_is_exact_in_one_step():
    model = gyroscope().at(1.0)
    rate, bias = np.array([2.0, -1.0, 0.5]), np.array([0.1, 0.2, -0.3])
    q = model.transition((1.0, 0.0, 0.0, 0.0, *bias), tuple(rate), model.constants)[:4]
    np.testing.assert_allclose(q, rotations.exponential(rate - bias), atol=4e-16)


@pytest.mark.parametrize("side", ["body", "world"])
def test_steps_are_of_order_four(side):
    """Half the step has a sixteenth of the error; both sides and scipy's integration agree."""
    from scipy.integrate import solve_ivp

    def slope(t, x):
        *rate, growth = twisted_rates(x, (), ())
        return *(0.5 * np.array(rotations.product(x[:4], (0.0, *rate)))), growth

    plant = twisted(side)
    exact = solve_ivp(slope, (0.0, 1.0), plant.point[0], rtol=1e-13, atol=1e-13).y[:, -1]
    coarse, fine = (np.abs(np.array(propagated(plant, 1.0, n)) - exact).max() for n in (16, 32))
    assert fine < 1e-5 and 14.0 < coarse / fine < 18.0


@pytest.mark.parametrize("side", ["body", "world"])
def test_the_slope_is_of_the_error_in_its_axes(side):
    """A of d' = A d: a state that is off by d, and both after a short time, by differences."""
    plant, dt = twisted(side), 1e-3
    x, turns = plant.point[0], plant.turns
    model = plant.at(dt)

    def after(d):
        return model.transition(tuple(move(x, d, turns)), (), model.constants)

    columns = [difference(after(1e-6 * d), after(-1e-6 * d), turns) for d in np.eye(4)]
    np.testing.assert_allclose(np.transpose(columns) / 2e-6, expm(plant.slope * dt), atol=3e-6)


def test_noise_is_that_of_the_continuous_density():
    """Of a gyroscope at rest it is a closed form; turning, Q of two halves makes that of the whole step."""
    dt = 0.5
    q = gyroscope().noise(dt)
    expected = [
        [GYRO**2 * dt + WALK**2 * dt**3 / 3, -(WALK**2) * dt**2 / 2],
        [-(WALK**2) * dt**2 / 2, WALK**2 * dt],
    ]
    np.testing.assert_allclose(q, np.kron(expected, np.eye(3)), rtol=1e-12, atol=1e-22)
    turning = gyroscope((1.0, -2.0, 0.5))
    half, F = turning.noise(dt / 2), expm(turning.slope * dt / 2)
    np.testing.assert_allclose(F[:3, :3], Turned.from_rotvec(np.array([1.0, -2.0, 0.5]) * dt / 2).as_matrix().T)
    np.testing.assert_allclose(F @ half @ F.T + half, turning.noise(dt), rtol=1e-9, atol=1e-18)


def test_a_continuous_model_is_found_again():
    """The plant of a discrete model has its steps and its noise."""
    model = gyroscope((0.3, 0.2, -0.1)).at(0.1)
    plant = ContinuousModel.of(model, measured_rates)
    np.testing.assert_allclose(plant.at(0.1).process_noise_cov, model.process_noise_cov, rtol=1e-9, atol=1e-18)
    with pytest.raises(ValueError, match="rates must be those of the model"):
        ContinuousModel.of(model, lambda x, u, c: (u[0], u[1], u[2], 1.0, 0.0, 0.0))


@pytest.mark.parametrize("kind", ["ekf", pytest.param("ukf", marks=pytest.mark.slow)])
def test_filters_take_it(kind):
    """Compiled as in Python; with exact measurements of a constant rate the attitude is the exponential.

    The unscented filter's points spread over the curved measurement, which biases it by 6e-5.
    """
    rate, model = np.array([0.3, -0.2, 0.1]), gyroscope().at(0.1)
    q = [rotations.exponential(rate * 0.1 * k) for k in range(11)]
    z = np.array([directions(x, ()) for x in q])

    def estimates():
        return filters.run(filters.make_filter(kind, model), inputs=np.tile(rate, (10, 1)), measurements=z)

    compiled = estimates()
    np.testing.assert_allclose(compiled.means[:, :4], q, atol=1e-12 if kind == "ekf" else 1e-3)
    if kind == "ekf":
        with interpreted():
            np.testing.assert_allclose(compiled.covs, estimates().covs, atol=1e-15)


def screw(x, u, c):
    """Rates of the tangent of a pose."""
    return 0.4, -0.3, 0.9, 1.0, 2.0, -3.0


def ahead_and_position(x, c):
    """The first axis of a pose, and where it is."""
    return *rotations.to_world(x[:4], (1.0, 0.0, 0.0)), *x[4:]


@pytest.mark.parametrize("side", ["body", "world"])
def test_constant_rates_of_a_pose_are_a_screw(side):
    """A step is the exponential, and errors propagate as by differences; directions have no rates."""
    common = {"rates": screw, "observe": ahead_and_position, "constants": Constants()}
    arguments = {"states": (Pose("camera", side=side),), "prior_mean": [0.6, 0.0, 0.8, 0.0, 1.0, 2.0, 3.0]}
    arguments |= {"prior_cov": np.ones(6), "measurement_noise_cov": np.ones(6)}
    model = ContinuousModel(densities=np.ones(6), arguments=arguments, **common)
    step, by = model.at(1.0), poses.exponential(screw(0, 0, 0))
    x, f = tuple(step.prior_mean), lambda y: step.transition(tuple(y), (), step.constants)
    after = poses.product(*((x, by) if side == "body" else (by, x)))
    np.testing.assert_allclose(f(x), after, atol=1e-14)
    columns = [difference(f(move(x, d, model.turns)), f(x), model.turns) for d in 1e-7 * np.eye(6)]
    np.testing.assert_allclose(np.transpose(columns) / 1e-7, expm(model.slope), atol=1e-5)
    arguments = {"states": (Direction("field"),), "prior_mean": (0.0, 0.0, 1.0)}
    with pytest.raises(ValueError, match="'field' is a direction"):
        ContinuousModel(densities=np.ones(2), arguments=arguments, **common | {"observe": lambda x, c: x})
