"""The model `heave`: heave, roll and pitch of a vessel from an IMU alone, in a sea of known period.

Rotation, sensors and the horizontal accelerations are those of `filters.attitude`. The displacement d upwards is a
wave of two oscillators in series, of which noise drives the second:

    d'' + 2 zeta w d' + w^2 d = e',   e'' + 2 zeta w e' + w^2 e = white noise,   w = 2 pi/T,   std d = H_s/4
    accelerometer:  R(q)' ((a_e, a_n, d'') + g) + (0, 0, b) + noise

It has no power at zero frequency, by e' in place of e, so that nothing drifts and no measurement of it is made up.
One filter has attitude and heave together, and their covariances.

Source: Fossen (2011), "Handbook of Marine Craft Hydrodynamics and Motion Control", section 8.2, of one oscillator;
the second makes the acceleration's power finite.
"""

from __future__ import annotations

import math

import numpy as np

from filters.attitude import AXES, FIRST_BIAS, GRAVITY, UNKNOWN, WORLD
from filters.models import oscillator
from filters.signals import block_diagonal
from thruster_env.core.checks import finite, positive
from thruster_env.model import rotations
from thruster_env.model.continuous import noise_of_densities
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import Rotation

SWAY, WAVE, BIAS = 7, 11, 15  # offsets of horizontal motion, the wave and the accelerometer's bias, as stored
GYRO_WALK, BIAS_WALK = 1e-6, 3e-5  # root densities [rad/s^2/sqrt(Hz)], [m/s^3/sqrt(Hz)]


# Constants c: dt, the steps of a horizontal oscillation (o, a) and of the wave by rows, the acceleration by the
# wave's first two states, gravity, and the field to the north and upwards.


def _turn(x, u, c):
    q = rotations.product(x[:4], rotations.exponential(tuple((u[i] - x[4 + i]) * c[0] for i in range(3))))
    sways = tuple(
        c[1 + 2 * row] * x[SWAY + i] + c[2 + 2 * row] * x[SWAY + 2 + i] for row in range(2) for i in range(2)
    )
    wave = tuple(sum(c[5 + 4 * row + k] * x[WAVE + k] for k in range(4)) for row in range(4))
    return *q, *x[4:7], *sways, *wave, *x[BIAS:]


def _sense(x, c):
    upwards = c[21] * x[WAVE] + c[22] * x[WAVE + 1] + x[WAVE + 3] + c[23]
    force = rotations.to_body(x[:4], (x[SWAY + 2], x[SWAY + 3], upwards))
    field = rotations.to_body(x[:4], (0.0, c[24], c[25]))
    return force[0], force[1], force[2] + x[BIAS], *field


def _roll(x, c):
    below = rotations.matrix(x[:4])[2]
    return np.arctan2(below[1], below[2])


def _pitch(x, c):
    below = rotations.matrix(x[:4])[2]
    return np.arctan2(-below[0], np.sqrt(below[1] * below[1] + below[2] * below[2]))


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
    walk, bias = GYRO_WALK**2, positive("accelerometer_bias", accelerometer_bias)
    gyro = [
        [positive("gyroscope", gyroscope) ** 2 * dt + walk * dt**3 / 3.0, -walk * dt**2 / 2.0],
        [-walk * dt**2 / 2.0, walk * dt],
    ]
    wave_noise = scale * noise_of_densities(density, slope, dt)
    noise = np.kron(gyro, np.eye(3)), np.kron(sway_noise, np.eye(2)), wave_noise, BIAS_WALK**2 * dt * np.eye(1)
    first = np.diag([UNKNOWN**2] * 3 + [FIRST_BIAS**2] * 3)
    prior = first, np.kron(swaying.first, np.eye(2)), scale * stationary, bias**2 * np.eye(1)
    inclination, strength = math.radians(finite("dip", dip)), positive("field", field)
    at_rest = positive("gravity", gravity), strength * math.cos(inclination), -strength * math.sin(inclination)
    steps = np.concatenate([sway.ravel(), expm(slope * dt).ravel(), slope[1, :2]])
    wave = zip(("heave", "heave velocity", "wave", "wave's rate"), ("heave", "v_u", "e", "a_u"), strict=True)
    units = "m", "m/s", "m/s", "m/s^2"
    return StateSpaceModel(
        transition=_turn,
        observe=_sense,
        process_noise_cov=block_diagonal(noise),
        measurement_noise_cov=[positive("accelerometer", accelerometer) ** 2] * 3
        + [positive("magnetometer", magnetometer) ** 2] * 3,
        prior_mean=[1.0] + [0.0] * 15,
        prior_cov=block_diagonal(prior),
        constants=(dt, *steps.tolist(), *at_rest),
        states=(
            Rotation("attitude"),
            *(Quantity(f"gyroscope bias {axis}", f"b_{axis}", "rad/s") for axis in AXES),
            *(Quantity(f"oscillation {axis}", f"o_{axis[0]}", "m/s^2") for axis in WORLD[:2]),
            *(Quantity(f"acceleration {axis}", f"a_{axis[0]}", "m/s^2") for axis in WORLD[:2]),
            *(Quantity(name, symbol, unit) for (name, symbol), unit in zip(wave, units, strict=True)),
            Quantity("accelerometer bias z", "b_a", "m/s^2"),
        ),
        input_quantities=[Quantity(f"gyroscope {axis}", f"gyr_{axis}", "rad/s") for axis in AXES],
        measurements=[
            *(Quantity(f"accelerometer {axis}", f"acc_{axis}", "m/s^2") for axis in AXES),
            *(Quantity(f"magnetometer {axis}", f"mag_{axis}", "uT") for axis in AXES),
        ],
        outputs={
            "roll": (Quantity("roll", "roll", "rad"), _roll),
            "pitch": (Quantity("pitch", "pitch", "rad"), _pitch),
        },
    )
