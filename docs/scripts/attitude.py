"""The table of docs/attitude.md on heave, roll and pitch in simulated seas."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

import filters
from filters.inertial import GRAVITY, WAVE, heave
from filters.starts import begun_at
from thruster_env.core.text_tables import markdown_table
from thruster_env.model import rotations

DT, SECONDS, SEEDS = 0.02, 420.0, 4
SEAS = (
    ("JONSWAP", 0.5, 4.0, 3.3),
    ("JONSWAP", 1.5, 6.0, 3.3),
    ("Pierson-Moskowitz", 1.5, 6.0, 1.0),
    ("JONSWAP", 4.0, 9.0, 3.3),
)
GYROSCOPE, GYRO_BIAS = np.radians(0.01), np.radians(0.2)  # [rad/s/sqrt(Hz)], [rad/s]
ACCELEROMETER, ACCELEROMETER_BIAS = 150e-6 * GRAVITY, 5e-3 * GRAVITY  # [m/s^2/sqrt(Hz)], [m/s^2]
FIELD, DIP = 50.0, np.degrees(np.arctan2(0.8, 0.6))  # [uT], [deg]


class Sea(NamedTuple):
    """A vessel's motion in waves and what its IMU measures, K steps."""

    height: float  # significant, of the waves [m]
    heave: np.ndarray  # (K,) [m]
    roll: np.ndarray  # (K,) [rad]
    pitch: np.ndarray
    gyro: np.ndarray  # (K - 1, 3), between the samples
    z: np.ndarray  # (K, 6)


def spectrum(w: np.ndarray, height: float, period: float, peak: float) -> np.ndarray:
    """Density of the waves' elevation [m^2 s] after JONSWAP; `peak` 1 is Pierson and Moskowitz's."""
    top = 2.0 * np.pi / period
    width = np.where(w <= top, 0.07, 0.09)
    shape = w**-5.0 * np.exp(-1.25 * (top / w) ** 4) * peak ** np.exp(-((w - top) ** 2) / (2 * (width * top) ** 2))
    return shape * height**2 / 16.0 / np.trapezoid(shape, w)


def sea(height: float, period: float, peak: float, seed: int, seconds: float = SECONDS) -> Sea:
    """A small boat in 300 waves of deep water from about one direction, its IMU at the centre of gravity.

    Heave follows the waves as 1/(1 + (w/2.5)^2), roll and pitch their slope with resonances at 2.2 and 2.8 rad/s.
    """
    draw, t = np.random.default_rng(seed), np.arange(int(seconds / DT) + 1) * DT
    w = np.linspace(0.25, 4.0, 300)
    w = np.sort(np.clip(w + draw.uniform(-0.5, 0.5, w.shape) * (w[1] - w[0]), 0.2, None))
    amplitude = np.sqrt(2.0 * spectrum(w, height, period, peak) * (3.75 / 299)) / (1.0 + (w / 2.5) ** 2)
    phase, heading = (
        draw.uniform(0.0, 2.0 * np.pi, w.shape),
        0.35 * draw.normal(size=w.shape) + draw.uniform(0.0, 6.28),
    )
    cosine, sine, slope = np.cos(heading), np.sin(heading), 1j * w**2 / GRAVITY * amplitude
    orbit = np.stack([1j * amplitude * cosine, 1j * amplitude * sine, amplitude + 0j], axis=-1)
    tilts = (
        slope * sine / (1.0 - (w / 2.2) ** 2 + 0.3j * w / 2.2),
        -slope * cosine / (1.0 - (w / 2.8) ** 2 + 0.7j * w / 2.8),
    )
    columns = np.concatenate([orbit, -(w**2)[:, None] * orbit, np.transpose(tilts)], axis=1)
    waves = (np.exp(1j * (np.outer(t, w) + phase)) @ columns).real
    yaw = draw.uniform(0.0, 6.28) + np.radians(4.0) * np.sin(2.0 * np.pi * t / 40.0)
    zero, roll, pitch = np.zeros_like(t), waves[:, 6], waves[:, 7]
    turns = [rotations.exponential(d) for d in ((zero, zero, yaw), (zero, pitch, zero), (roll, zero, zero))]
    q = np.array(rotations.product(rotations.product(turns[0], turns[1]), turns[2]))
    rate = np.transpose(rotations.logarithm(rotations.product(rotations.inverse(q[:, :-1]), q[:, 1:]))) / DT
    force = np.transpose(rotations.to_body(q, (waves[:, 3], waves[:, 4], waves[:, 5] + GRAVITY)))
    field = np.transpose(rotations.to_body(q, (0.0, 0.6 * FIELD, -0.8 * FIELD)))
    biases = GYRO_BIAS * draw.normal(size=3), ACCELEROMETER_BIAS * draw.normal(size=3)
    gyro = rate + biases[0] + GYROSCOPE / DT**0.5 * draw.normal(size=rate.shape)
    acc = force + biases[1] + ACCELEROMETER / DT**0.5 * draw.normal(size=force.shape)
    z = np.hstack([acc, field + 0.01 * FIELD * draw.normal(size=field.shape)])
    return Sea(height, waves[:, 2], roll, pitch, gyro, z)


def model_of(height: float, period: float, **changes: Any):
    """The model that knows the sea, the boat's answer at its peak, and the sensors' data sheets."""
    height /= 1.0 + (2.0 * np.pi / period / 2.5) ** 2
    noise = {"gyroscope": GYROSCOPE, "accelerometer": ACCELEROMETER / DT**0.5, "magnetometer": 0.01 * FIELD}
    return heave(
        DT, height, period, accelerometer_bias=ACCELEROMETER_BIAS, field=FIELD, dip=DIP, **noise | changes
    )


def errors(model, of: Sea) -> dict[str, float]:
    """Root mean squares of errors in the last third, in real time, and heave's stated deviation [m], [deg]."""
    begun = model.replace(prior_mean=begun_at(model, of.z[:1])[0])
    estimates = filters.run(filters.ExtendedKalmanFilter(model=begun), inputs=of.gyro, measurements=of.z)
    late = slice(2 * len(of.z) // 3, None)
    roll, pitch = (model.output(name, estimates.means[late]) for name in ("roll", "pitch"))
    return {
        "heave": float(np.sqrt(np.mean((estimates.means[late, WAVE] - of.heave[late]) ** 2))),
        "stated": float(np.sqrt(np.mean(estimates.covs[late, WAVE - 1, WAVE - 1]))),
        "roll": float(np.degrees(np.sqrt(np.mean((roll - of.roll[late]) ** 2)))),
        "pitch": float(np.degrees(np.sqrt(np.mean((pitch - of.pitch[late]) ** 2)))),
    }


def heave_in_seas() -> str:
    """Errors in four seas, over four seeds each."""
    rows = []
    for name, height, period, peak in SEAS:
        model = model_of(height, period)
        parts = [errors(model, sea(height, period, peak, seed)) for seed in range(SEEDS)]
        rms = {key: np.sqrt(np.mean([part[key] ** 2 for part in parts])) for key in parts[0]}
        lengths = [f"{100.0 * rms[what]:.1f} cm" for what in ("heave", "stated")]
        angles = [f"{rms[what]:.2f} deg" for what in ("roll", "pitch")]
        share = f"{100.0 * rms['heave'] / height:.2f} %"
        rows.append([f"{name}, {height:g} m, {period:g} s", share, *lengths, *angles])
    return markdown_table(["sea, H_s, T", "heave, of H_s", "heave", "stated", "roll", "pitch"], rows)


TABLES = {"heave_in_seas": heave_in_seas}
