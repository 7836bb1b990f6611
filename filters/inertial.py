"""Models of inertial sensors: `attitude` of a body, `heave` of a vessel in waves, `inertial_navigation` with GPS.

**attitude**: a rotation by gyroscope, accelerometer and magnetometer, with the noise of data sheets. The gyroscope
is the input; its bias walks. World axes are east, north, up, with magnetic north. The acceleration of the sensor
on each world axis is an oscillation without a mean, as that of whatever stays in a room, on a body or on a vessel:

    q(t + dt) = q exp((u - b) dt),   b' = w_b,   o'' + 2 zeta w_0 o' + w_0^2 o = w_o,   a = o'/w_0
    accelerometer:  R(q)' (a + g) + noise,   magnetometer:  R(q)' B (0, cos(dip), -sin(dip)) + noise

Likelihood is a trap where the acceleration is not that of the model: it is higher with more noise of the
gyroscope, which then pays for what the acceleration does, and attitudes are worse. So the gyroscope's two numbers
are those of its data sheet or of a record at rest, and `FREE` are the others. An acceleration with power at zero
frequency, such as white noise or a first-order process, is taken for a tilt.

**heave** has the same rotation, sensors and horizontal accelerations. The displacement d upwards is a wave of two
oscillators in series, of which noise drives the second:

    d'' + 2 zeta w d' + w^2 d = e',   e'' + 2 zeta w e' + w^2 e = white noise,   w = 2 pi/T,   std d = H_s/4
    accelerometer:  R(q)' ((a_e, a_n, d'') + g) + (0, 0, b) + noise

It has no power at zero frequency, by e' in place of e, so that nothing drifts and no measurement of it is made up.
One filter has attitude and heave together, and their covariances.

Sources: Hertzberg, Wagner, Frese, Schroeder (2013), of `thruster_env.model.turns`; noise densities: IEEE Std 952
(1997), annex C. The accelerations are those of a sea state's heave, as in Fossen (2011), "Handbook of Marine Craft
Hydrodynamics and Motion Control", section 8.2, of one oscillator; heave's second makes the power finite.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from filters.models import oscillator
from filters.signals import block_diagonal
from thruster_env.core.checks import finite, positive
from thruster_env.model import poses, rotations
from thruster_env.model.continuous import noise_of_densities
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import ExtendedPose, Rotation, Turn

GRAVITY = 9.81  # [m/s^2]
UNKNOWN = 2.0  # standard deviation of the first attitude on each axis [rad], which is none
FIRST_BIAS = 0.02  # of a gyroscope [rad/s]
FIRST_YAW = 0.01  # where no magnetometer gives it, and it counts from the start [rad]
AXES = "xyz"
WORLD = ("east", "north", "up")
GYROSCOPE = tuple(Quantity(f"gyroscope {axis}", f"gyr_{axis}", "rad/s") for axis in AXES)
MEASURED = (
    *(Quantity(f"accelerometer {axis}", f"acc_{axis}", "m/s^2") for axis in AXES),
    *(Quantity(f"magnetometer {axis}", f"mag_{axis}", "uT") for axis in AXES),
)
TURNING = (Rotation("attitude"), *(Quantity(f"gyroscope bias {axis}", f"b_{axis}", "rad/s") for axis in AXES))
OSCILLATION = (
    *(Quantity(f"oscillation {axis}", f"o_{axis[0]}", "m/s^2") for axis in WORLD),
    *(Quantity(f"acceleration {axis}", f"a_{axis[0]}", "m/s^2") for axis in WORLD),
)
FIRST = [UNKNOWN**2] * 3 + [FIRST_BIAS**2] * 3  # variances of these
# What a log of motion determines.
FREE = ("accelerometer", "magnetometer", "acceleration", "frequency", "damping", "field", "dip", "gravity")


class Sensors(NamedTuple):
    """Numbers of f and h: the step of an oscillation (o, a), and what sensors at rest measure."""

    dt: float
    o_by_o: float
    o_by_a: float
    a_by_o: float
    a_by_a: float
    gravity: float
    north: float
    up: float


def _gyroscope_noise(density: float, walk: float, dt: float) -> np.ndarray:
    """Q (6, 6) of rotation and bias in a step, by the densities of a gyroscope's noise and of its bias's rate."""
    turning, walk = positive("gyroscope", density) ** 2 * dt, walk**2
    each = [[turning + walk * dt**3 / 3.0, -walk * dt**2 / 2.0], [-walk * dt**2 / 2.0, walk * dt]]
    return np.kron(each, np.eye(3))


def _sensor_variances(accelerometer: float, magnetometer: float) -> list[float]:
    accelerometer, magnetometer = positive("accelerometer", accelerometer), positive("magnetometer", magnetometer)
    return [accelerometer**2] * 3 + [magnetometer**2] * 3


def _at_rest(gravity: float, field: float, dip: float) -> tuple[float, float, float]:
    """What sensors measure that stand still: gravity, and the field to the north and upwards."""
    inclination, strength = math.radians(finite("dip", dip)), positive("field", field)
    return positive("gravity", gravity), strength * math.cos(inclination), -strength * math.sin(inclination)


def _turn(x, u, c):
    q = rotations.product(x[:4], rotations.exponential(tuple((u[i] - x[4 + i]) * c.dt for i in range(3))))
    oscillation = tuple(c.o_by_o * x[7 + i] + c.o_by_a * x[10 + i] for i in range(3))
    return *q, *x[4:7], *oscillation, *(c.a_by_o * x[7 + i] + c.a_by_a * x[10 + i] for i in range(3))


def _sense(x, c):
    accelerometer = rotations.to_body(x[:4], (x[10], x[11], x[12] + c.gravity))
    return *accelerometer, *rotations.to_body(x[:4], (0.0, c.north, c.up))


def _turn_imu(x, u, c):
    turned = _turn((*x[:4], *x[10:], *x[4:10]), u, c)
    return *turned[:4], *turned[7:], *turned[4:7]


def _sense_imu(x, c):
    return rotations.to_body(x[:4], (x[7], x[8], x[9] + c.gravity))


def _oscillation(dt: float, *numbers: float) -> tuple[np.ndarray, np.ndarray]:
    """The step and Q of an acceleration by its frequency, damping and deviation."""
    names = "frequency", "damping", "acceleration"
    swing = oscillator(*(positive(name, value) for name, value in zip(names, numbers, strict=True)))
    return swing.step(positive("dt", dt))


def attitude(
    dt: float = 0.01,
    gyroscope: float = 2e-4,
    bias_walk: float = 1e-5,
    accelerometer: float = 0.02,
    magnetometer: float = 1.0,
    acceleration: float = 1.0,
    frequency: float = 1.0,
    damping: float = 0.3,
    field: float = 50.0,
    dip: float = 60.0,
    gravity: float = GRAVITY,
) -> StateSpaceModel:
    """A rotation with the bias of its gyroscope, and an acceleration that oscillates; the file has the equations.

    P and Q are of errors of the body: a rotation vector [rad], then bias, oscillation and acceleration. The prior
    knows no attitude: `filters.starts.begun_at` begins at that of the first measurement.

    Args:
        dt: sample time [s].
        gyroscope: noise density of the gyroscope, its angle random walk [rad/s/sqrt(Hz)].
        bias_walk: density of its bias's rate, the rate random walk [rad/s^2/sqrt(Hz)].
        accelerometer: deviation of a sample of the accelerometer [m/s^2].
        magnetometer: deviation of a sample of the magnetometer [uT].
        acceleration: deviation of the sensor's acceleration on each axis [m/s^2].
        frequency: of the acceleration [Hz].
        damping: its damping ratio.
        field: magnetic field strength B [uT], or whatever unit the magnetometer has.
        dip: angle of the field below the horizon [deg].
        gravity: g [m/s^2], as the accelerometer measures it.

    Raises:
        ValueError: if a number is not positive, but for the dip.
    """
    step, pair = _oscillation(dt, frequency, damping, acceleration)
    gyro = _gyroscope_noise(gyroscope, positive("bias_walk", bias_walk), dt)
    return StateSpaceModel(
        transition=_turn,
        observe=_sense,
        process_noise_cov=block_diagonal([gyro, np.kron(pair, np.eye(3))]),
        measurement_noise_cov=_sensor_variances(accelerometer, magnetometer),
        prior_mean=[1.0] + [0.0] * 12,
        prior_cov=FIRST + [acceleration**2] * 6,
        constants=Sensors._make([dt, *step.ravel().tolist(), *_at_rest(gravity, field, dip)]),
        states=(*TURNING, *OSCILLATION),
        input_quantities=GYROSCOPE,
        measurements=MEASURED,
    )


attitude.free = FREE  # type: ignore[attr-defined]  # of `tuning.identify`, where no parameter is named


def attitude_imu(
    dt: float = 0.01,
    gyroscope: float = 2e-4,
    bias_walk: float = 1e-5,
    accelerometer: float = 0.02,
    acceleration: float = 1.0,
    frequency: float = 1.0,
    damping: float = 0.3,
    gravity: float = GRAVITY,
) -> StateSpaceModel:
    """`attitude` without a magnetometer: yaw begins at about 0, and drifts with the gyroscope's bias about up.

    Rotation, oscillation and acceleration are one element of SE_2(3), as an `ExtendedPose` with errors of the
    world, of which those about up are known at the start. With this the slope of h by an error about up is zero,
    so that measurements tell nothing of yaw, whose deviation grows.

    Args:
        dt: sample time [s].
        gyroscope: as `attitude` takes it [rad/s/sqrt(Hz)].
        bias_walk: likewise [rad/s^2/sqrt(Hz)].
        accelerometer: deviation of a sample of the accelerometer [m/s^2].
        acceleration: deviation of the sensor's acceleration on each axis [m/s^2].
        frequency: of the acceleration [Hz].
        damping: its damping ratio.
        gravity: g [m/s^2], as the accelerometer measures it.

    Raises:
        ValueError: if a number is not positive.
    """
    step, pair = _oscillation(dt, frequency, damping, acceleration)
    gyro = _gyroscope_noise(gyroscope, positive("bias_walk", bias_walk), dt)
    names, quaternion = TURNING[1:], Rotation("attitude").quantities
    return StateSpaceModel(
        transition=_turn_imu,
        observe=_sense_imu,
        process_noise_cov=block_diagonal([gyro[:3, :3], np.kron(pair, np.eye(3)), gyro[3:, 3:]]),
        measurement_noise_cov=_sensor_variances(accelerometer, 1.0)[:3],
        prior_mean=[1.0] + [0.0] * 12,
        prior_cov=[*FIRST[:2], FIRST_YAW**2, *[acceleration**2] * 6, *FIRST[3:]],
        constants=Sensors._make([dt, *step.ravel().tolist(), positive("gravity", gravity), 0.0, 0.0]),
        states=(*quaternion, *OSCILLATION, *names),
        turns=(Turn(0, 0, "world", "attitude", "extended pose", 9),),
        input_quantities=GYROSCOPE,
        measurements=MEASURED[:3],
    )


attitude_imu.free = ("accelerometer", "acceleration", "frequency", "damping", "gravity")  # type: ignore[attr-defined]


SWAY, WAVE, BIAS = 7, 11, 15  # offsets of horizontal motion, the wave and the accelerometer's bias, as stored
GYRO_WALK, BIAS_WALK = 1e-6, 3e-5  # root densities [rad/s^2/sqrt(Hz)], [m/s^3/sqrt(Hz)]


# Constants c: dt, the steps of a horizontal oscillation (o, a) and of the wave by rows, the acceleration by the
# wave's first two states, gravity, and the field to the north and upwards.


def _move(x, u, c):
    q = rotations.product(x[:4], rotations.exponential(tuple((u[i] - x[4 + i]) * c[0] for i in range(3))))
    sways = tuple(
        c[1 + 2 * row] * x[SWAY + i] + c[2 + 2 * row] * x[SWAY + 2 + i] for row in range(2) for i in range(2)
    )
    wave = tuple(sum(c[5 + 4 * row + k] * x[WAVE + k] for k in range(4)) for row in range(4))
    return *q, *x[4:7], *sways, *wave, *x[BIAS:]


def _measure(x, c):
    upwards = c[21] * x[WAVE] + c[22] * x[WAVE + 1] + x[WAVE + 3] + c[23]
    force = rotations.to_body(x[:4], (x[SWAY + 2], x[SWAY + 3], upwards))
    field = rotations.to_body(x[:4], (0.0, c[24], c[25]))
    return force[0], force[1], force[2] + x[BIAS], *field


def heave(
    dt: float = 0.02,
    significant_height: float = 1.5,
    period: float = 6.0,
    damping: float = 0.2,
    gyroscope: float = 2e-4,
    accelerometer: float = 0.01,
    accelerometer_bias: float = 0.05,
    magnetometer: float = 0.5,
    field: float = 50.0,
    dip: float = 60.0,
    gravity: float = GRAVITY,
) -> StateSpaceModel:
    """A vessel in waves: attitude, gyroscope's bias, horizontal motion, heave, accelerometer's bias upwards.

    P and Q are of errors of the body, a rotation vector [rad], then of the other states. World axes are east,
    north, up, those of the body ahead, to port, up. Outputs are roll (starboard down) and pitch (bow down) [rad].

    Args:
        dt: sample time [s].
        significant_height: H_s of the vessel's heave [m], four standard deviations.
        period: T, of the peak of the waves' spectrum as the vessel meets them [s].
        damping: zeta, the width of the spectrum.
        gyroscope: noise density of the gyroscope [rad/s/sqrt(Hz)].
        accelerometer: deviation of a sample of the accelerometer [m/s^2].
        accelerometer_bias: deviation of its bias along z [m/s^2]. Roll and pitch are off by those of the other
            axes over g, which look like a tilt and are not in the stated deviations.
        magnetometer: deviation of a sample of the magnetometer [uT].
        field: magnetic field strength [uT].
        dip: angle of the field below the horizon [deg].
        gravity: g [m/s^2].

    Raises:
        ValueError: if a number is not positive, but for the dip.
    """
    from scipy.linalg import expm, solve_continuous_lyapunov

    dt, w = positive("dt", dt), 2.0 * math.pi / positive("period", period)
    damped, std = 2.0 * positive("damping", damping) * w, positive("significant_height", significant_height) / 4.0
    slope = np.array([[0, 1, 0, 0], [-w * w, -damped, 0, 1], [0, 0, 0, 1], [0, 0, -w * w, -damped]])
    density = np.diag([0.0, 0.0, 0.0, 1.0])
    stationary = solve_continuous_lyapunov(slope, -density)
    scale = std**2 / stationary[0, 0]
    swaying = oscillator(
        1.0 / period, damping, std * math.sqrt(slope[1] @ stationary @ slope[1] / stationary[0, 0])
    )
    sway, sway_noise = swaying.step(dt)
    bias, gyro = positive("accelerometer_bias", accelerometer_bias), _gyroscope_noise(gyroscope, GYRO_WALK, dt)
    wave_noise = scale * noise_of_densities(density, slope, dt)
    noise = gyro, np.kron(sway_noise, np.eye(2)), wave_noise, BIAS_WALK**2 * dt * np.eye(1)
    prior = np.diag(FIRST), np.kron(swaying.first, np.eye(2)), scale * stationary, bias**2 * np.eye(1)
    steps = np.concatenate([sway.ravel(), expm(slope * dt).ravel(), slope[1, :2]])
    wave = zip(("heave", "heave velocity", "wave", "wave's rate"), ("heave", "v_u", "e", "a_u"), strict=True)
    units = "m", "m/s", "m/s", "m/s^2"
    return StateSpaceModel(
        transition=_move,
        observe=_measure,
        process_noise_cov=block_diagonal(noise),
        measurement_noise_cov=_sensor_variances(accelerometer, magnetometer),
        prior_mean=[1.0] + [0.0] * 15,
        prior_cov=block_diagonal(prior),
        constants=(dt, *steps.tolist(), *_at_rest(gravity, field, dip)),
        states=(
            *TURNING,
            *(Quantity(f"oscillation {axis}", f"o_{axis[0]}", "m/s^2") for axis in WORLD[:2]),
            *(Quantity(f"acceleration {axis}", f"a_{axis[0]}", "m/s^2") for axis in WORLD[:2]),
            *(Quantity(name, symbol, unit) for (name, symbol), unit in zip(wave, units, strict=True)),
            Quantity("accelerometer bias z", "b_a", "m/s^2"),
        ),
        input_quantities=GYROSCOPE,
        measurements=MEASURED,
    )


class Flight(NamedTuple):
    """Numbers of f of `inertial_navigation`."""

    dt: float
    gravity: float


def _fly(x, u, c):
    rate, force = tuple(u[i] - x[10 + i] for i in range(3)), tuple(u[3 + i] - x[13 + i] for i in range(3))
    return *poses.strapdown(x[:10], rate, force, (0.0, 0.0, -c.gravity), c.dt), *x[10:]


def _fix(x, c):
    return *x[7:10], x[9] + x[16]


def inertial_navigation(
    dt: float = 0.01,
    gyroscope: float = 2e-4,
    bias_walk: float = 1e-5,
    accelerometer: float = 2e-3,
    accelerometer_walk: float = 1e-4,
    gps: float = 1.5,
    barometer: float = 0.3,
    barometer_walk: float = 0.02,
    tilt_std: float = 2.0,
    heading: float = 0.0,
    heading_std: float = 5.0,
    gyroscope_bias: float = 0.005,
    accelerometer_bias: float = 0.05,
    gravity: float = GRAVITY,
) -> StateSpaceModel:
    """Attitude, velocity and position of a craft by an IMU, which is the input, GPS and a barometer.

        (q, v, p)' = strapdown((q, v, p), u_g - b_g, u_a - b_a, (0, 0, -g), dt)
        GPS:  p + noise,   barometer:  p_z + b + noise

    World axes are east, north, up from a place nearby, so longitude and latitude must be turned into metres. The
    craft is one element of SE_2(3) with errors of the body; biases of gyroscope, accelerometer and barometer walk.
    GPS and barometer come at their own rates, NaN between. Without acceleration, nothing measures the heading.
    From first errors of twice the default ones an extended filter's NEES is a quarter too large.

    Args:
        dt: sample time [s], of the IMU.
        gyroscope: noise density of the gyroscope, its angle random walk [rad/s/sqrt(Hz)].
        bias_walk: density of its bias's rate [rad/s^2/sqrt(Hz)].
        accelerometer: noise density of the accelerometer, its velocity random walk [m/s^2/sqrt(Hz)].
        accelerometer_walk: density of its bias's rate [m/s^3/sqrt(Hz)].
        gps: deviation of a position on each axis [m].
        barometer: deviation of a height [m].
        barometer_walk: density of the rate of the barometer's bias [m/s/sqrt(Hz)].
        tilt_std: deviation of the first roll and pitch, which are zero [deg].
        heading: first yaw, from east to north [deg].
        heading_std: its deviation [deg].
        gyroscope_bias: deviation of its first bias on each axis [rad/s].
        accelerometer_bias: likewise [m/s^2].
        gravity: g [m/s^2].

    Raises:
        ValueError: if a deviation, density, dt or gravity is not positive.
    """
    gyro = _gyroscope_noise(gyroscope, positive("bias_walk", bias_walk), positive("dt", dt))
    walk = positive("accelerometer_walk", accelerometer_walk)
    densities = np.diag([positive("accelerometer", accelerometer) ** 2, 0.0, walk**2])  # of v, p and the bias
    moving = noise_of_densities(densities, [[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dt)
    noise, turning, steady = np.zeros((16, 16)), [*range(3), *range(9, 12)], [*range(3, 9), *range(12, 15)]
    noise[np.ix_(turning, turning)], noise[np.ix_(steady, steady)] = gyro, np.kron(moving, np.eye(3))
    noise[15, 15] = positive("barometer_walk", barometer_walk) ** 2 * dt
    tilt, yaw = (math.radians(positive(*std)) for std in (("tilt_std", tilt_std), ("heading_std", heading_std)))
    first = 0.5 * math.radians(finite("heading", heading))
    biases = [positive("gyroscope_bias", gyroscope_bias)] * 3 + [
        positive("accelerometer_bias", accelerometer_bias)
    ] * 3
    stds = tilt, tilt, yaw, *[5.0] * 3, *[3.0 * gps] * 3, *biases, 20.0
    return StateSpaceModel(
        transition=_fly,
        observe=_fix,
        process_noise_cov=noise,
        measurement_noise_cov=[positive("gps", gps) ** 2] * 3 + [positive("barometer", barometer) ** 2],
        prior_mean=[math.cos(first), 0.0, 0.0, math.sin(first)] + [0.0] * 13,
        prior_cov=np.square(stds),
        constants=Flight(dt, positive("gravity", gravity)),
        states=(
            ExtendedPose("craft"),
            *TURNING[1:],
            *(Quantity(f"accelerometer bias {axis}", f"d_{axis}", "m/s^2") for axis in AXES),
            Quantity("barometer bias", "b_h", "m"),
        ),
        input_quantities=(*GYROSCOPE, *MEASURED[:3]),
        measurements=(
            *(Quantity(f"GPS {axis}", f"gps_{axis[0]}", "m") for axis in WORLD),
            Quantity("barometer height", "baro", "m"),
        ),
    )
