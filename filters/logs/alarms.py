"""Alarms of a monitor over a log, and the channel without which they are gone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from filters.logs.estimate import LogEstimate, estimate_with
from filters.monitoring.monitor import Alarm, Monitor
from thruster_env.logs.stamps import date_text, time_text
from thruster_env.model.quantities import Quantity


class LogAlarms(NamedTuple):
    """What a monitor says of a log; steps of alarms are rows of it."""

    monitor: Monitor
    first: int  # the row at which the tests begin
    alarms: tuple[Alarm, ...]
    without: tuple[int, ...] | None  # statistical alarms without each channel; None where that was not asked for

    @property
    def at_fault(self) -> int | None:
        """The channel without which the fewest alarms are left, if at most half are; None without one."""
        found = self.without
        if not found or not self.alarms:
            return None
        order = sorted(range(len(found)), key=found.__getitem__)
        clear = len(order) < 2 or found[order[0]] < found[order[1]]
        return order[0] if clear and 2 * found[order[0]] <= len(_statistical(self.alarms)) else None


def alarms_of(found: LogEstimate, monitor: Monitor, first: int = 0, *, isolate: bool = False) -> LogAlarms:
    """The alarms of an estimate of a log.

    Args:
        found: from `filters.logs.estimate.estimate`.
        monitor: the tests.
        first: the row at which they begin, once the filter has settled.
        isolate: whether to run the filter without each channel, too, and count the alarms of the others.

    Raises:
        ValueError: for a filter without a covariance, and to isolate the only channel.
    """
    if not found.filter.has_covariance:
        raise ValueError(f"a monitor needs a filter with a covariance, but {found.filter.name!r} has none")
    measurements = found.log.measurements
    without = None
    if isolate:
        channels = measurements.shape[1]
        if channels < 2:
            raise ValueError("a faulty channel can be isolated among two or more, but the filter has one")
        without = tuple(len(_statistical(_without(found, monitor, first, one))) for one in range(channels))
    return LogAlarms(monitor, first, tuple(_alarms(found, monitor, first)), without)


def _alarms(found: LogEstimate, monitor: Monitor, first: int) -> list[Alarm]:
    seen = found.innovations[first:], found.innovation_covs[first:], found.log.measurements[first:]
    return [one._replace(step=one.step + first, since=one.since + first) for one in monitor.alarms(*seen)]


def _without(found: LogEstimate, monitor: Monitor, first: int, channel: int) -> list[Alarm]:
    """Alarms of a filter that does not see a channel."""
    measurements = found.log.measurements.copy()
    measurements[:, channel] = np.nan
    again = estimate_with(found.filter, replace(found.log, measurements=measurements), noise=found.noise)
    return [one for one in _alarms(again, monitor, first) if one.channel != channel]


def _statistical(alarms: Sequence[Alarm]) -> list[Alarm]:
    return [one for one in alarms if one.test not in ("stuck", "missing")]


def episodes(alarms: Sequence[Alarm], memory: int) -> list[list[Alarm]]:
    """Alarms of a channel that follow each other within some steps, by their first."""
    found: list[list[Alarm]] = []
    for one in alarms:
        last = next((some for some in reversed(found) if some[-1].channel == one.channel), None)
        if last is not None and one.step - last[-1].step <= memory:
            last.append(one)
        else:
            found.append([one])
    return found


def episode_sentence(some: Sequence[Alarm], channel: Quantity, times: np.ndarray) -> str:
    """An episode: "thrust: a bias of +0.32 N since 12.5 s, found at 14.1 s (cusum)".

    It begins with its first alarm; where the sensor is stuck or missing, with that, which explains the others.
    """
    one = next((alarm for alarm in some if alarm.test in ("stuck", "missing")), some[0])
    unit = f" {channel.unit}" if channel.unit else ""
    what = {
        "outlier": f"an outlier {one.size:+.3g}{unit} off",
        "variance": f"noise with {one.size:.2g} times the expected variance",
        "stuck": "equal readings",
        "missing": "no readings",
    }.get(one.test, f"a bias of {one.size:+.3g}{unit}")
    dt = float(np.median(np.diff(times)))
    at = [time_text(times[step], dt, 5) for step in (one.since, one.step, some[-1].step)]
    since = "" if one.test == "outlier" else f" since {at[0]} s, found"
    found = f"{channel.symbol}: {what}{since} at {at[1]} s{date_text(times[one.step])} ({one.test})"
    others = list(dict.fromkeys(alarm.test for alarm in some if alarm is not one))
    if not others:
        return found
    return f"{found}; {len(some) - 1} more until {at[2]} s ({', '.join(others)})"
