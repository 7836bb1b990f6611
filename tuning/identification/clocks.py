"""Clock offsets of a log's channels as free parameters: `clock_offset_CHANNEL`, positive if its clock is ahead.

An offset covers a constant delay, too: of a sensor whose reading arrives late, or of an actuator that acts late,
whose offset is negative.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from thruster_env.logs.grid import NEIGHBOURS
from thruster_env.logs.log import Log, at_offset
from tuning.problems.problem import Parameter

CLOCK = "clock_offset_"  # at the beginning of a parameter's name
OFFSETS = 10.0  # largest clock offset, in sample times, but at least
LEAST_OFFSET = 0.1  # [s]


def clock_offsets(channels: Sequence[str], logs: Sequence[Log]) -> dict[str, Parameter]:
    """The parameter of each channel's clock offset by name, ten steps about that of the logs."""
    parameters, reach = {}, max(OFFSETS * logs[0].dt, LEAST_OFFSET)
    for channel in channels:
        name, at = f"{CLOCK}{channel}", _read_with(logs, channel)
        parameters[name] = Parameter(name, at - reach, at + reach, "s", log=False, default=at)
    return parameters


def shifted(logs: Sequence[Log], free: Sequence[Parameter]) -> tuple[Log, ...] | ShiftedLogs:
    """The logs, or a function of the clock offsets that are free."""
    names = tuple(parameter.name for parameter in free if parameter.name.startswith(CLOCK))
    return ShiftedLogs(logs, names) if names else tuple(logs)


def offsets_of(logs: Sequence[Log], channels: Sequence[str], values: Mapping[str, float]) -> dict[str, float]:
    """Clock offsets [s] by channel that are not zero: identified ones, or those of the logs."""
    offsets = {channel: values.get(CLOCK + channel, _read_with(logs, channel)) for channel in channels}
    return {channel: value for channel, value in offsets.items() if value}


def _read_with(logs: Sequence[Log], channel: str) -> float:
    """The clock offset with which all logs were read; 0 if they differ, since they then belong to the logs."""
    keys = f"measurement:{channel}", f"input:{channel}"
    offsets = {next((log.offsets[key] for key in keys if key in log.offsets), 0.0) for log in logs}
    return offsets.pop() if len(offsets) == 1 else 0.0


class ShiftedLogs:
    """Logs as a function of clock offsets of their channels [s].

    Of a shifted channel only every other row is used. It is interpolated between two samples, so that the noise of
    consecutive rows is correlated, and a likelihood of white noise would prefer a wrong offset. Every other row
    shares no sample with the next one.
    """

    def __init__(self, logs: Sequence[Log], names: Sequence[str]):
        """Take logs, and names such as clock_offset_CHANNEL."""
        self.logs, self.parameters = tuple(logs), tuple(names)

    def __call__(self, **offsets: float) -> list[Log]:
        """The logs with shifted clocks of the channels."""
        return [self._shifted(log, offsets) for log in self.logs]

    def noise_factors(self, **offsets: float) -> dict[str, float]:
        """Factors on the variance of white noise in each shifted channel, by symbol.

        An interpolated sample has weights w and 1 - w of its neighbours, and its noise w^2 + (1 - w)^2 of their
        variance. A likelihood without this factor would prefer offsets of half a sample.
        """
        factors = {}
        for name, seconds in offsets.items():
            symbol = name.removeprefix(CLOCK)
            if symbol not in [quantity.symbol for quantity in self.logs[0].measured]:
                continue  # an input is held, not interpolated
            parts = [_left(log, f"measurement:{symbol}", seconds) for log in self.logs]
            factors[symbol] = float(np.mean(np.concatenate(parts)))
        return factors

    def _shifted(self, log: Log, offsets: Mapping[str, float]) -> Log:
        symbols = [quantity.symbol for quantity in log.measured]
        for name, seconds in offsets.items():
            symbol = name.removeprefix(CLOCK)
            channel = f"{'measurement' if symbol in symbols else 'input'}:{symbol}"
            dense = symbol in symbols and np.median(np.diff(log.series(channel).times)) < NEIGHBOURS * log.dt
            log = at_offset(log, channel, seconds)
            if dense:
                rows = log.measurements.copy()
                rows[1::2, symbols.index(symbol)] = np.nan
                log = replace(log, measurements=rows)
        return log


def _left(log: Log, channel: str, seconds: float) -> np.ndarray:
    """w^2 + (1 - w)^2 of each row of a shifted channel that lies between two close samples."""
    samples = log.series(channel).times
    times = log.times + seconds
    after = np.clip(np.searchsorted(samples, times), 1, len(samples) - 1)
    gap = samples[after] - samples[after - 1]
    w = (times - samples[after - 1]) / gap
    between = (w >= 0) & (w <= 1) & (gap < NEIGHBOURS * log.dt)
    return w[between] ** 2 + (1 - w[between]) ** 2 if between.any() else np.ones(1)
