"""Allan deviation of an inertial sensor at rest, and the noise that it tells: `thruster log imu.csv --allan`.

Of samples x of a rate, with the angle theta, the overlapping estimate over clusters of tau = m dt is

    sigma^2(tau) = mean_k (theta_{k+2m} - 2 theta_{k+m} + theta_k)^2 / (2 tau^2)
                 = N^2/tau + (2 ln 2/pi) B^2 + K^2 tau/3

with the random walk N, a density of white noise, the instability B of the bias and its random walk K. These are
fitted to the squares by least squares, not below zero; intervals are 1.96 deviations over simulated records of
the fitted noise.

Source: IEEE Std 952 (1997), annex C; flicker noise of the simulation: Kasdin (1995), "Discrete simulation of
colored noise and stochastic processes and 1/f^alpha power law noise generation", Proc. IEEE 83(5).
"""

from __future__ import annotations

import math
from os import PathLike
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from filters.consistency.nees import Interval
from thruster_env.core.files import BLUE, GREY, new_figure, tidy
from thruster_env.logs.columns import NO_COLUMN
from thruster_env.logs.log import Log
from thruster_env.logs.read import read_log
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SENSORS = {"gyr": ("gyroscope", "rad/s", 0.1), "acc": ("accelerometer", "m/s^2", 0.5)}  # and how much rest moves
SHORTEST = 120.0  # s
POINTS, FEWEST = 40, 8  # cluster times, and clusters in the record at the longest
RECORDS, FITS = 40, 4  # simulated, for intervals; with the weights of the fit before
FLICKER = 2.0 * math.log(2.0) / math.pi
TERMS = {"N": "random walk", "B": "instability", "K": "rate random walk"}


class Allan(NamedTuple):
    """The Allan deviation of a channel, and its noise."""

    quantity: Quantity
    times: np.ndarray  # tau [s]
    deviations: np.ndarray
    noise: dict[str, Interval]  # N [unit sqrt(s)], B [unit], K [unit/sqrt(s)]

    def fitted(self, tau: np.ndarray) -> np.ndarray:
        """The deviation of the fitted noise at times [s]."""
        return np.sqrt(_terms(tau) @ np.array([value.value**2 for value in self.noise.values()]))


def allan_deviation(values: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Cluster times [s] and the overlapping Allan deviation of samples (N,), as the file's head has it."""
    angle = np.append(0.0, np.cumsum(values - values.mean())) * dt
    sizes = np.unique(np.geomspace(1, max(len(values) // FEWEST, 1), POINTS).astype(int))
    seconds = [angle[2 * m :] - 2.0 * angle[m:-m] + angle[: -2 * m] for m in sizes]
    taus = sizes * dt
    return taus, np.array([np.sqrt(np.mean(d**2) / 2.0) for d in seconds]) / taus


def noise_of(values: np.ndarray, dt: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, dict]:
    """Cluster times, deviations, and N, B and K with 95 % intervals, of samples (N,) at rest.

    Args:
        values: in the channel's unit.
        dt: sample time [s].
        rng: of the simulated records.
    """
    taus, deviations = allan_deviation(values, dt)
    squares = _fit(taus, deviations, len(values) * dt)
    fits = [_simulated_fit(squares, len(values), dt, rng) for _ in range(RECORDS)]
    spread = 1.96 * np.std(fits, axis=0)
    ends = [np.sqrt(np.maximum(squares + sign * spread, 0.0)) for sign in (-1.0, 1.0)]
    rows = zip(TERMS, np.sqrt(squares), *ends, strict=True)
    return taus, deviations, {name: Interval(float(v), float(low), float(high)) for name, v, low, high in rows}


def _terms(tau: np.ndarray) -> np.ndarray:
    return np.stack([1.0 / tau, np.full_like(tau, FLICKER), tau / 3.0], axis=-1)


def _fit(taus: np.ndarray, deviations: np.ndarray, duration: float) -> np.ndarray:
    """N^2, B^2 and K^2, weighted by the deviation of each square, about sigma^2 sqrt(2 tau/T) of the fit."""
    from scipy.optimize import nnls

    expected = deviations**2
    for _ in range(FITS):
        weights = np.sqrt(duration / taus) / expected
        rows = _terms(taus) * weights[:, None]
        scales = np.linalg.norm(rows, axis=0)
        squares = nnls(rows / scales, weights * deviations**2)[0] / scales
        expected = _terms(taus) @ squares
    return squares


def _simulated_fit(squares: np.ndarray, count: int, dt: float, rng: np.random.Generator) -> np.ndarray:
    white, flicker, walk = np.sqrt(squares)
    values = white / math.sqrt(dt) * rng.standard_normal(count)
    values += walk * math.sqrt(dt) * np.cumsum(rng.standard_normal(count))
    if flicker:
        values += flicker * flicker_noise(rng.standard_normal(count))
    return _fit(*allan_deviation(values, dt), count * dt)


def flicker_noise(white: np.ndarray) -> np.ndarray:
    """Noise with the density 1/(2 pi f) from white noise (N,) of variance 1: half an integration."""
    steps = np.arange(1, len(white))
    response = np.append(1.0, np.cumprod((steps - 0.5) / steps))
    size = 2 * len(white)
    return np.fft.irfft(np.fft.rfft(response, size) * np.fft.rfft(white, size), size)[: len(white)]


def at_rest(path: str | PathLike, **reading: Any) -> Log:
    """A log's gyroscope and, if it has them, accelerometer columns; ValueError unless long enough and at rest."""
    try:
        log = read_log(path, _columns_of(*SENSORS), **reading)
    except ValueError as error:
        if NO_COLUMN not in str(error) or "gyr_" in str(error).partition(", but ")[0]:
            raise
        log = read_log(path, _columns_of("gyr"), **reading)
    if log.stamps is not None or len(log.pieces) > 1:
        raise ValueError(f"a log for --allan must be on a grid, without gaps, but {log.name} is not")
    if log.steps * log.dt < SHORTEST:
        raise ValueError(
            f"a log for --allan must be at least {SHORTEST:g} s, but {log.name} has {log.steps * log.dt:.3g} s"
        )
    size = max(round(1.0 / log.dt), 1)
    for quantity, values in zip(log.measured, log.measurements.T, strict=True):
        most = SENSORS[quantity.symbol[:3]][2]
        means = np.nanmean(values[: len(values) // size * size].reshape(-1, size), axis=1)
        if np.ptp(means) > most:
            raise ValueError(
                f"a log for --allan must be at rest, but means of {quantity.symbol} over {size * log.dt:.3g} s "
                f"differ by {np.ptp(means):.3g} {quantity.unit}"
            )
    return log


def _columns_of(*sensors: str) -> StateSpaceModel:
    """A model whose measurements are the axes of sensors."""
    measured = [
        Quantity(f"{SENSORS[sensor][0]} {axis}", f"{sensor}_{axis}", SENSORS[sensor][1])
        for sensor in sensors
        for axis in "xyz"
    ]
    ones = [1.0] * len(measured)
    return StateSpaceModel(
        transition=_same,
        observe=_as_it_is,
        process_noise_cov=ones,
        measurement_noise_cov=ones,
        prior_mean=ones,
        prior_cov=ones,
        inputs=0,
        measurements=measured,
    )


def _same(x, u, c):
    return x


def _as_it_is(x, c):
    return x


def allan_of(log: Log, seed: int = 0) -> list[Allan]:
    """The Allan deviation and noise of each channel of a log at rest; missing samples are interpolated."""
    rng, rows = np.random.default_rng(seed), np.arange(log.steps + 1)
    results = []
    for quantity, values in zip(log.measured, log.measurements.T, strict=True):
        known = ~np.isnan(values)
        filled = np.interp(rows, rows[known], values[known])
        results.append(Allan(quantity, *noise_of(filled, log.dt, rng)))
    return results


def start_values(channels: list[Allan], dt: float) -> dict[str, float]:
    """Arguments of `attitude`: the largest N and K of the gyroscope, and the deviation of an acceleration."""
    gyroscope = [channel.noise for channel in channels if channel.quantity.symbol.startswith("gyr")]
    acceleration = [channel.noise for channel in channels if channel.quantity.symbol.startswith("acc")]
    walks = [noise["K"] for noise in gyroscope]
    values = {
        "gyroscope": max(noise["N"].value for noise in gyroscope),
        "bias_walk": max(walk.value if walk.low > 0.0 else walk.high for walk in walks),
    }
    if acceleration:
        values["accelerometer"] = max(noise["N"].value for noise in acceleration) / math.sqrt(dt)
    return values


def sentences(channels: list[Allan], log: Log) -> list[str]:
    """What is not determined, and the start values for `attitude`."""
    duration, texts = log.steps * log.dt, []
    for name, what in TERMS.items():
        unknown = [channel.quantity.symbol for channel in channels if channel.noise[name].low == 0.0]
        if unknown:
            texts.append(
                f"{duration:.4g} s do not determine {name}, the {what}, of {', '.join(unknown)}: it is at most "
                "the upper end."
            )
    values = ",".join(f"{name}={value:.2g}" for name, value in start_values(channels, log.dt).items())
    return [
        *texts,
        f"Start values: --model attitude:{values}; in motion, accelerations are less certain than at rest.",
    ]


def rows_of(channels: list[Allan]) -> list[list[str]]:
    """A row of cells for each channel: N, B and K with intervals."""
    return [[c.quantity.symbol, c.quantity.unit, *map(_cell, c.noise.values())] for c in channels]


def _cell(value: Interval) -> str:
    return f"{value.value:.3g} [{value.low:.3g}, {value.high:.3g}]"


def draw_allan(channels: list[Allan], title: str) -> Figure:
    """Allan deviations over cluster times, logarithmic, with the fitted noise; a panel a sensor."""
    groups: dict[str, list[Allan]] = {}
    for channel in channels:
        groups.setdefault(channel.quantity.symbol[:3], []).append(channel)
    figure = new_figure((5.4 * len(groups), 4.2))
    axes = figure.subplots(1, len(groups), squeeze=False)[0]
    tidy(axes)
    for axis, (sensor, parts) in zip(axes, groups.items(), strict=True):
        for channel, style in zip(parts, ("-", "--", ":"), strict=False):
            axis.loglog(
                channel.times, channel.deviations, color=BLUE, linestyle=style, label=channel.quantity.symbol
            )
            axis.loglog(channel.times, channel.fitted(channel.times), color=GREY, linestyle=style, linewidth=0.9)
        axis.set_title(f"{SENSORS[sensor][0]}; grey: fitted noise", fontsize=10)
        axis.set_xlabel("cluster time [s]")
        axis.set_ylabel(f"Allan deviation [{SENSORS[sensor][1]}]")
        axis.legend(frameon=False)
    figure.suptitle(title, fontsize=11)
    return figure
