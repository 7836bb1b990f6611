"""What the vehicle does: surge, turns, dives, the published paths, and how stable it runs straight."""

import math

import numpy as np
import pytest
from scipy.optimize import fsolve

from thruster_env.auv.dynamics import (
    cruise_thrust,
    motion_rates,
    motion_rates_tangent,
    navigation_substep,
    required_substeps,
    top_speed,
    velocity_rates_tangent,
)
from thruster_env.auv.parameters import (
    LAUV,
    PRESETS,
    REMUS100,
    REMUS100_PRESTERO,
    SEGOROGENI,
    SEGOROGENI_PAPERS,
    derive_constants,
)
from tuning.experiments.vehicle_papers import planar_kinematics

THRUST, TORQUE, DEGREE = 2.845, -0.017, math.pi / 180
C = derive_constants(SEGOROGENI)


def run(x, u, seconds, k=SEGOROGENI, dt=0.05):
    """States (steps + 1, 12) under inputs u, or u(t) amid a step, from a state x or its first entries."""
    steps = round(seconds / dt)
    c, x = derive_constants(k, seconds / steps), (*x, *(0.0,) * (12 - len(x)))
    path = [x]
    for i in range(steps):
        x = navigation_substep(x, u((i + 0.5) * seconds / steps) if callable(u) else u, c)
        path.append(x)
    return np.array(path)


def steady(u, start, k=SEGOROGENI):
    """The state (8,) that does not change under inputs u, near a start."""
    c = derive_constants(k)
    x, _, found, message = fsolve(lambda y: motion_rates(tuple(y), u, c), start, full_output=True, xtol=1e-12)
    assert found == 1, message
    return x


def eigenvalues(k, speed=1.0):
    """Of the eight states, straight ahead."""
    x, u = (speed, *(0.0,) * 7), (cruise_thrust(k, speed), 0.0, 0.0, 0.0)
    columns = [motion_rates_tangent(x, tuple(e), u, derive_constants(k)) for e in np.eye(8).tolist()]
    found = np.linalg.eigvals(np.transpose(columns))
    return found[np.lexsort((found.imag, found.real))]


def test_thrust_holds_the_printed_speed_and_surge_is_reached_in_time():
    assert cruise_thrust(SEGOROGENI, 1.0) == pytest.approx(2.845, abs=5e-4)
    assert top_speed(SEGOROGENI, 4.0) == pytest.approx(1.19, abs=5e-3)
    for k in PRESETS.values():
        assert top_speed(k, cruise_thrust(k, 0.8)) == pytest.approx(0.8, rel=1e-12)
    speed = run((0.0,), (THRUST, 0.0, 0.0, 0.0), 20)[:, 0]
    np.testing.assert_allclose(speed[[20, 40, 60, 100, 200]], [0.18, 0.34, 0.49, 0.72, 0.95], atol=0.006)
    assert speed[400] == pytest.approx(0.9985, abs=2e-4)
    with pytest.raises(ValueError, match="must be a drag, negative or zero and not both zero, but got 0.0, 0.5"):
        top_speed(SEGOROGENI._replace(Xuu=0.5), 1.0)


TURNS = np.array(
    [
        [1, 0.992, 3.70, 15.4, 0.37],
        [2, 0.974, 6.81, 8.20, 0.67],
        [3, 0.950, 9.44, 5.78, 0.91],
        [5, 0.897, 13.62, 3.79, 1.24],
        [10, 0.772, 20.1, 2.22, 1.57],
        [15, 0.676, 23.7, 1.66, 1.62],
        [20, 0.605, 26.0, 1.37, 1.59],
    ]
)


def test_the_rudder_turns_to_port_as_tabulated():
    x = np.array([0.95, 0.0, 0.0, 0.0, 0.0, -0.05, 0.0, 0.0])
    for rudder, speed, rate, radius, roll in TURNS:
        x = steady((THRUST, 0.0, 0.0, rudder * DEGREE), x)
        assert x[5] < 0
        assert x[0] == pytest.approx(speed, abs=2e-3)
        assert -x[5] / DEGREE == pytest.approx(rate, rel=5e-3)
        assert math.hypot(x[0], x[1]) / -x[5] == pytest.approx(radius, rel=6e-3)
        assert abs(x[6]) / DEGREE == pytest.approx(roll, abs=0.011)


def test_the_stern_plane_dives_as_tabulated():
    for plane, pitch, depth in ((2, -5.9, 3.3), (5, -14.8, 8.3), (10, -30.3, 16.7), (15, -48.7, 25.2)):
        path = run((1.0,), (THRUST, 0.0, plane * DEGREE, 0.0), 40, dt=0.1)
        assert path[-1, 7] / DEGREE == pytest.approx(pitch, abs=0.06)
        assert path[-1, 11] == pytest.approx(depth, abs=0.06)
    steep = run((1.0,), (THRUST, 0.0, 20 * DEGREE, 0.0), 80, dt=0.1)
    assert steep[-1, 7] / DEGREE == pytest.approx(-83, abs=0.6)


def test_eigenvalues_of_the_straight_run_are_the_documented_ones():
    expected = [-2.79, -2.07, -1.98 - 6.39j, -1.98 + 6.39j, -0.72 - 0.88j, -0.72 + 0.88j, -0.70, -0.36]
    np.testing.assert_allclose(eigenvalues(SEGOROGENI), expected, atol=6e-3)
    roll = eigenvalues(SEGOROGENI_PAPERS)[-1]
    assert (roll.real, abs(roll.imag)) == pytest.approx((-0.03, 6.69), abs=5e-3)
    x, u = (1.0, *(0.0,) * 5), (THRUST, *(0.0,) * 5)
    columns = [velocity_rates_tangent(x, tuple(e), u, C) for e in np.eye(6).tolist()]
    found = np.sort(np.linalg.eigvals(np.transpose(columns)).real)
    np.testing.assert_allclose(found, [-3.90, -2.86, -2.81, -0.70, -0.68, -0.36], atol=6e-3)


def test_all_presets_but_the_printed_one_run_straight():
    for k in PRESETS.values():
        assert (eigenvalues(k)[-1].real > 0) == (k == REMUS100_PRESTERO)
    unstable = eigenvalues(REMUS100_PRESTERO)
    assert unstable[-1] == pytest.approx(0.66, abs=5e-3)
    assert unstable[-2] == pytest.approx(0.21 + 0.44j, abs=6e-3)
    disturbed = run((1.0, 0.02, 0.02, 0.05, 0.05, 0.05), (THRUST, 0.0, 0.0, 0.0), 60, dt=0.1)
    np.testing.assert_allclose(disturbed[-1, :8], [1.0, *(0.0,) * 7], atol=1e-4)
    assert (eigenvalues(LAUV).real < -0.1).all()


def test_remus_by_the_recipe_turns_as_documented():
    u = (cruise_thrust(REMUS100, 1.5), 0.0, 0.0, 4 * DEGREE)
    x = run((1.5,), u, 30, REMUS100)[-1]  # before it slows down as far as a steady turn has it
    assert -x[5] / DEGREE == pytest.approx(12.7, rel=0.06)
    assert math.hypot(x[0], x[1]) / -x[5] == pytest.approx(5.6, rel=0.06)


def switching(t):
    """The inputs of the dynamic path: thrust and both planes, each switched with a period of its own."""

    def sign(period):
        return np.sign(math.sin(2 * math.pi * t / period))

    thrust = THRUST * (1 + 0.4 * sign(9))
    return thrust, -0.006 * thrust, 5 * DEGREE * sign(14), 5 * DEGREE * sign(10)


def fixed(stern, rudder):
    return THRUST, TORQUE, stern * DEGREE, rudder * DEGREE


MANOEUVRES = {  # inputs, seconds, end, largest v w p q r, largest phi theta, error of the planar transformation
    "I": (fixed(0, -5), 25, (-2.415, 3.789, 0.114), (0.082, 0.001, 0.038, 0.024, 0.238), (0.9, 1.7)),
    "II": (fixed(5, 0), 25, (20.752, 0.022, 3.770), (0.0, 0.041, 0.038, 0.034, 0.0), (0.7, 14.8)),
    "III": (fixed(0, 0), 25, (21.143, 0.0, 0.063), (0.0, 0.001, 0.038, 0.024, 0.0), (0.7, 1.7)),
    "IV": (
        fixed(6.0483275, -1.3502966),
        31.560424,
        (10.0, 18.0, 6.0),
        (0.033, 0.047, 0.038, 0.041, 0.086),
        (0.7, 17.3),
    ),
    "dynamic": (switching, 25, (19.01, -4.69, 0.02), (0.094, 0.081, 0.092, 0.290, 0.271), (2.5, 14.8)),
}
PLANAR = {
    "I": (0.002, 0.001, 0.061, 0.0005),
    "II": (0.164, 0.011, 2.28, 0.001),
    "III": (0.001, 0.0, 0.050, 0.0001),
    "IV": (0.497, 0.168, 3.73, 0.046),
    "dynamic": (0.102, 0.024, 0.360, 0.008),
}


def planar_path(path, seconds):
    """x, y, z, psi by the papers' transformation of true velocities: the trapezoid of its rates."""
    dt, pose = seconds / (len(path) - 1), np.zeros((len(path), 4))
    pose[1:, 3] = np.cumsum((path[1:, 5] + path[:-1, 5]) / 2 * dt)
    rates = np.transpose(np.broadcast_arrays(*planar_kinematics(tuple(path.T[:6]), pose[:, 3])))
    pose[1:, :3] = np.cumsum((rates[1:, :3] + rates[:-1, :3]) / 2 * dt, axis=0)
    return pose


@pytest.mark.parametrize("name", MANOEUVRES)
def test_published_paths_end_where_they_should(name):
    u, seconds, end, largest, angles = MANOEUVRES[name]
    path = run((), u, seconds)
    digit = 0.02 if name == "dynamic" else 2e-3
    np.testing.assert_allclose(path[-1, 9:], end, atol=digit)
    np.testing.assert_allclose(np.abs(path[:, 1:6]).max(axis=0), largest, atol=2e-3)
    np.testing.assert_allclose(np.abs(path[:, 6:8]).max(axis=0) / DEGREE, angles, atol=0.06)
    error = planar_path(path, seconds) - path[:, [9, 10, 11, 8]]
    np.testing.assert_allclose(np.sqrt(np.mean(error**2, axis=0)), PLANAR[name], rtol=0.03, atol=1e-3)


def test_more_substeps_are_taken_only_where_a_step_is_long():
    plane = 15 * DEGREE
    for k in PRESETS.values():
        counts = [required_substeps(k, dt, 4.0, plane) for dt in (0.001, 0.05, 0.1, 0.2)]
        assert counts[:2] == [1, 1] and 2 <= counts[2] <= counts[3] <= 8
    with pytest.raises(ValueError, match="dt must be short enough for 64 Runge-Kutta steps .*, but got 10.0"):
        required_substeps(SEGOROGENI_PAPERS, 10.0, 4.0, plane)
