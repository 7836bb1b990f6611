"""Assessment of a filter's run over a log, by its innovations and hidden channels, and a picture of it.

The picture has states, outputs and innovations over time, each with its 95 % band. The hues are near those of
Okabe and Ito, with a wine red: colour-blind people can distinguish them. Filters that are often drawn together
differ in hue, and no two share both hue and dash. Truth is a wide grey line below all, measurements are pale.

Source: Okabe, Ito (2008), "Color universal design".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import isnan
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import chdtri

from filters.consistency.nees import LAGS, Whiteness, blow_up_sentence, root_mean_square, whitened, whiteness_of
from filters.logs.estimate import SKIPPED, LogEstimate, estimate_with, lost_in_gaps
from filters.monitoring import Alarm, Monitor
from thruster_env.core.angles import difference, with_breaks, wrapped
from thruster_env.core.checks import at_least
from thruster_env.core.files import (
    BLUE,
    GREEN,
    MUSTARD,
    PALE,
    PLUM,
    RUST,
    SKY,
    TRUE,
    WINE,
    legend_below,
    new_figure,
    tidy,
)
from thruster_env.core.sources import as_value, is_array
from thruster_env.core.text_tables import TITLE, verbatim
from thruster_env.logs.columns import OUTPUT, STATE, plain, suffix
from thruster_env.logs.findings import GAP, OUTLIER, SPOILING, sentences
from thruster_env.model import rotations
from thruster_env.model.euler import EulerAngle, euler_outputs
from thruster_env.model.quantities import Quantity
from thruster_env.model.simulate import inputs_until
from thruster_env.model.turns import of_channels, readings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ALPHA = 0.05  # below which a p-value speaks against white innovations

# Of the picture.
SOLID, DASHED, DOTTED, BOTH, TWO_DOTS = "-", "--", ":", "-.", (0, (4, 1.5, 1, 1.5, 1, 1.5))
TRUTH: dict[str, Any] = {"color": TRUE, "linewidth": 3.0, "zorder": 1.8}  # wide, below the estimates
MEASURED: dict[str, Any] = {"color": PALE, "linewidth": 0.8}
SPARSE: dict[str, Any] = {"marker": ".", "markersize": 3.0, "linewidth": 0.0}  # of a slow sensor
OTHER = (GREEN, DOTTED)  # an estimator of one's own
TWO_SIDED = 1.96
MOST_PANELS = 6  # of states and outputs
TALL, LOW, WIDTH = 1.5, 1.1, 9.0  # [inch]
ROOM = 0.6  # for title and legend [inch]
ALARM = "tab:red"
FEWEST_MOVES = 10  # rows in which an input changes, for each input
FOLLOWS = 0.5  # share of the innovations' squares that changes of the input explain, from which it is named
MARGIN = 0.06  # of an axis above and below what it shows
DOTS: dict[str, Any] = {"color": "0.5", "s": 4.0, "linewidths": 0, "label": "measurement", "zorder": 1.5}
DRIFT = 2.0  # deviation of yaw at the end over the first, beyond which it is said to drift


class Residual(NamedTuple):
    """Error of a prediction or an estimate with respect to a channel of the log."""

    quantity: Quantity
    rmse: float  # in the channel's unit
    bias: float  # mean of estimate less channel
    rows: int  # in which there was something to compare


class LogFindings(NamedTuple):
    """Results over the rows that count; NaN without covariance or innovation, or where nothing was measured."""

    first: int  # the first row that counts
    rows: int  # that count, and in which something was measured
    mean_nis: float  # over the number of channels that were there: 1 is right
    nis_band: tuple[float, float]  # in which it lies with 95 % probability if the filter is consistent
    whiteness: Whiteness | None  # None without a covariance, or with fewer rows than lags
    predictions: tuple[Residual, ...]  # one step ahead, by channel
    log_likelihood: float
    references: tuple[Residual, ...]  # by reference channel that the model has


def findings(estimate: LogEstimate, skip: int | None = None) -> LogFindings:
    """The findings of an estimate of a log.

        mean NIS = sum nu' S^-1 nu / sum m_k,  95 % band: chi^2 of sum m_k degrees of freedom, over these

    Args:
        estimate: from `filters.logs.estimate.estimate`.
        skip: first rows that do not count; 50, or a quarter of a short log, if None.

    Raises:
        ValueError: if no row is left.

    Source: Bar-Shalom, Li, Kirubarajan (2001), section 5.4 (time-average NIS of one run).
    """
    log, rows = estimate.log, estimate.log.steps + 1
    first = at_least("skip", min(SKIPPED, rows // 4) if skip is None else skip, 0, rows - 1)
    innovations, covs = estimate.innovations[first:], estimate.innovation_covs[first:]
    present = ~np.isnan(innovations)
    measured, count = (~np.isnan(log.measurements[first:])).any(axis=1), int(present.sum())
    nis, band, white = np.nan, (np.nan, np.nan), None
    if estimate.filter.has_covariance and np.isfinite(covs[present.any(axis=1)]).any():
        e = whitened(np.where(present, innovations, 0.0), covs)
        nis = float((np.where(present, e, 0.0) ** 2).sum() / count)
        band = float(chdtri(count, 0.975) / count), float(chdtri(count, 0.025) / count)
        white = whiteness_of(e[None], present[None]) if len(e) > LAGS else None
    predictions = [
        _residual(quantity, -innovations[:, j]) for j, quantity in enumerate(estimate.innovation_quantities)
    ]
    references = [
        _residual(*_in_degrees(quantity, estimate, reference_errors(estimate, key)[first:]))
        for key, (quantity, _) in compared(estimate).items()
    ]
    references += [_residual(quantity, errors[first:]) for quantity, errors in _turned(estimate)]
    return LogFindings(
        first,
        int(measured.sum()),
        nis,
        band,
        white,
        tuple(predictions),
        float(estimate.log_likelihoods[first:].sum()),
        tuple(references),
    )


def compared(estimate: LogEstimate) -> dict[str, tuple[Quantity, np.ndarray]]:
    """The references of a log (K + 1,) that the filter's model has as a state or an output, by channel.

    A quaternion is compared by its roll, pitch and yaw, since q and -q are the same attitude.
    """
    log, model = estimate.log, estimate.model
    states, outputs = {state.symbol for state in model.states}, set(model.outputs)
    known = {STATE: states}
    references = {
        key: (log.referred[key], values)
        for key, values in log.references.items()
        if key.partition(":")[2] in known.get(key.partition(":")[0], outputs)
    }
    for _, keys, q in _quaternions(estimate):
        for key in keys:
            del references[key]
        at = next(i for i, state in enumerate(model.states) if f"{STATE}:{state.symbol}" == keys[0])
        for symbol, output in model.outputs.items():
            if isinstance(output.function, EulerAngle) and output.function.stored == at:
                values = rotations.euler(q)[output.function.axis]
                references[f"{OUTPUT}:{symbol}"] = output.quantity, values
    return references


def _quaternions(estimate: LogEstimate) -> list[tuple[Quantity, list[str], list[np.ndarray]]]:
    """The angle of each rotation whose reference a log has, the channels and the numbers of this (K + 1,)."""
    model, log, result = estimate.model, estimate.log, []
    for turn in model.turns:
        symbols = [state.symbol for state in model.states[turn.quaternion]]
        keys = [f"{STATE}:{symbol}" for symbol in symbols]
        if turn.kind != "direction" and all(key in log.references for key in keys):
            quantity = Quantity(f"{turn.name} angle", f"{symbols[0].rpartition('_')[0]}_angle", "deg")
            result.append((quantity, keys, [log.references[key] for key in keys]))
    return result


def _turned(estimate: LogEstimate) -> list[tuple[Quantity, np.ndarray]]:
    """The angle [deg] between estimate and reference (K + 1,) of each rotation that the log has."""
    angles = []
    for quantity, keys, q in _quaternions(estimate):
        back = rotations.inverse([estimated(estimate, key)[0] for key in keys])
        apart = np.stack(rotations.logarithm(rotations.product(back, q)))
        angles.append((quantity, np.rad2deg(np.sqrt((apart**2).sum(axis=0)))))
    return angles


def _in_degrees(quantity: Quantity, estimate: LogEstimate, values: Any) -> tuple[Quantity, Any]:
    """An output's quantity and values, those of roll, pitch and yaw of a rotation in degrees."""
    output = estimate.model.outputs.get(quantity.symbol)
    if output is None or not isinstance(output.function, EulerAngle):
        return quantity, values
    return quantity._replace(unit="deg"), np.rad2deg(values)


def estimated(estimate: LogEstimate, channel: str) -> tuple[np.ndarray, np.ndarray]:
    """The estimate of a reference channel, (K + 1,), and its standard deviation."""
    kind, _, symbol = channel.partition(":")
    if kind != STATE:
        return estimate.output(symbol)
    i = [state.symbol for state in estimate.model.states].index(symbol)
    return estimate.means[:, i], estimate.stds[:, i]


def reference_errors(estimate: LogEstimate, channel: str) -> np.ndarray:
    """Estimate less reference, (K + 1,), angles the short way round; NaN where the reference has no sample."""
    values, (quantity, reference) = estimated(estimate, channel)[0], compared(estimate)[channel]
    return difference(values[:, None], reference[:, None], (quantity.angle,))[:, 0]


def _residual(quantity: Quantity, errors: np.ndarray) -> Residual:
    present = errors[~np.isnan(errors)]
    if not present.size:
        return Residual(quantity, np.nan, np.nan, 0)
    largest = float(abs(present).max()) or 1.0  # by which sums stay finite where a model blows up
    return Residual(quantity, root_mean_square(present), float((present / largest).mean() * largest), present.size)


# The results of a filter's run over a log, in words.


def verdict(estimate: LogEstimate, log_findings: LogFindings) -> list[str]:
    """Findings in the log, then what the innovations say about filter and model.

    Where a prediction is a thousand times further off than the channel moves, the model blows up between samples,
    and its Q and R are not to blame.
    """
    messages = sentences(estimate.log.findings) + ([estimate.restarts.sentence] if estimate.restarts else [])
    messages += drift_sentences(estimate)
    spoilt = [finding for finding in estimate.log.findings if finding.kind in SPOILING]
    if any(finding.kind == GAP for finding in spoilt):
        messages.append("At a gap the filter predicts with the last input held.")
    lost = lost_in_gaps(estimate.model, estimate.log)
    if lost:
        after = "the gap" if len(lost) == 1 else f"{len(lost)} gaps"
        messages.append(
            f"The sensor turns in gaps: after {after} the filter begins anew at the first measurement."
        )
    if not log_findings.rows:
        return [
            *messages,
            f"Nothing was measured in the rows that count, from {log_findings.first} on: "
            "there are no innovations.",
        ]
    if all(isnan(residual.rmse) for residual in log_findings.predictions):
        silent = "This estimator gives no innovation, so there is no NIS, no whiteness and no likelihood."
        return [*messages, silent]
    names = [quantity.name for quantity in estimate.innovation_quantities]
    measurements = readings(estimate.log.measurements, estimate.model.measured_turns)
    blown = blow_up_sentence(estimate.innovations[log_findings.first :], measurements, names, estimate.log.dt)
    if blown:
        return [*messages, blown]
    if isnan(log_findings.mean_nis):
        return [*messages, "This filter gives no covariance, so there is no NIS and no likelihood."]
    low, high = log_findings.nis_band
    conclusion = "The mean NIS is in its 95 % band."
    if log_findings.mean_nis > high:
        conclusion = (
            "The innovations are larger than the filter expects: its Q or R is too small, or the model is off."
        )
        messages += feedthrough_sentences(estimate, log_findings.first)
    elif log_findings.mean_nis < low:
        conclusion = "The innovations are smaller than the filter expects: its Q or R is too large."
    if log_findings.whiteness is not None and log_findings.whiteness.p_value < ALPHA:
        conclusion += " They are not white: a better model could predict a part of them."
    if spoilt:
        kinds = list(dict.fromkeys(finding.kind for finding in spoilt))
        conclusion += f" First mend what was found in the log ({', '.join(kinds)}): it spoils these numbers."
        if OUTLIER in kinds and "robust" not in estimate.filter.name:
            conclusion += " The filter ekf-robust gives outliers less weight."
    return [*messages, conclusion]


def drift_sentences(estimate: LogEstimate) -> list[str]:
    """That yaw drifts, of each rotation whose deviation of yaw is larger at the end than after the first row."""
    result = []
    for symbol, output in estimate.model.outputs.items():
        if isinstance(output.function, EulerAngle) and output.function.axis == 2:
            first, last = np.rad2deg(estimate.output(symbol)[1][[0, -1]])
            if last > DRIFT * first:
                grows = f"The deviation of {symbol} grows from {first:.2g} to {last:.2g} deg: it drifts, as "
                result.append(grows + "measurements do not determine it (a magnetometer does).")
    return result


def feedthrough_sentences(estimate: LogEstimate, first: int = 0) -> list[str]:
    """The channels whose innovations are those of a measurement that depends on the input of its own row.

        v_k - v_{k-1} = b' (u_k - u_{k-1}) + e_k

    in rows in which the input u of the file changes, explains at least half of the squares, and more than the
    changes of the row before do.

    Args:
        estimate: whose innovations are larger than the filter expects.
        first: the first row that counts.
    """
    log = estimate.log
    inputs, count = np.diff(log.input_rows, axis=0)[first:], log.inputs.shape[1]
    shares = [
        (_explained(changes, inputs), _explained(changes[1:], inputs[:-1]))
        for changes in np.diff(estimate.innovations, axis=0)[first:].T
    ]
    remedy = 'read the log with inputs_act="until"' if estimate.model.feeds else "give h(x, u, c)"
    return [
        f"Changes of the input in the same row explain {100.0 * now:.0f} % of those of the innovations of "
        f"{quantity.name}: measurements follow the input of the same instant, so {remedy} (or a controller's "
        "answer to them is recorded in their row)."
        for quantity, (now, before) in zip(estimate.innovation_quantities, shares, strict=True)
        if count and now >= FOLLOWS and now > before
    ]


def _explained(changes: np.ndarray, inputs: np.ndarray) -> float:
    """The share of squares of changes (K,) that changes of the inputs (K, p) explain; 0 of too few."""
    rows = np.isfinite(changes) & np.isfinite(inputs).all(axis=1) & (inputs != 0.0).any(axis=1)
    y, x = changes[rows], inputs[rows]
    if rows.sum() < FEWEST_MOVES * inputs.shape[1] or not y.any():
        return 0.0
    rest = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float(1.0 - (rest @ rest) / (y @ y))


# Alarms of a monitor over a log, and the channel without which they are gone.


class LogAlarms(NamedTuple):
    """The alarms of a monitor on a log; steps of alarms are rows of the log."""

    monitor: Monitor
    first: int  # the row at which the tests begin
    alarms: tuple[Alarm, ...]
    without: tuple[int, ...] | None  # statistical alarms without each channel; None where that was not asked for

    @property
    def at_fault(self) -> int | None:
        """The channel without which the fewest alarms are left, if at most half are; None without one."""
        counts = self.without
        if not counts or not self.alarms:
            return None
        order = sorted(range(len(counts)), key=counts.__getitem__)
        clear = len(order) < 2 or counts[order[0]] < counts[order[1]]
        return order[0] if clear and 2 * counts[order[0]] <= len(_statistical(self.alarms)) else None


def alarms_of(estimate: LogEstimate, monitor: Monitor, first: int = 0, *, isolate: bool = False) -> LogAlarms:
    """The alarms of an estimate of a log.

    Args:
        estimate: from `filters.logs.estimate.estimate`.
        monitor: the tests.
        first: the row at which they begin, once the filter has settled.
        isolate: whether to run the filter without each channel, too, and count the alarms of the others.

    Raises:
        ValueError: for a filter without a covariance, and to isolate the only channel.
    """
    if not estimate.filter.has_covariance:
        raise ValueError(f"a monitor needs a filter with a covariance, but {estimate.filter.name!r} has none")
    without = None
    if isolate:
        channels = estimate.model.m
        if channels < 2:
            raise ValueError("a faulty channel can be isolated among two or more, but the filter has one")
        without = tuple(
            len(_statistical(_alarms_without(estimate, monitor, first, channel))) for channel in range(channels)
        )
    return LogAlarms(monitor, first, tuple(_alarms(estimate, monitor, first)), without)


def _alarms(estimate: LogEstimate, monitor: Monitor, first: int) -> list[Alarm]:
    measurements = readings(estimate.log.measurements[first:], estimate.model.measured_turns)
    tested = estimate.innovations[first:], estimate.innovation_covs[first:], measurements
    return [
        alarm._replace(step=alarm.step + first, since=alarm.since + first) for alarm in monitor.alarms(*tested)
    ]


def _alarms_without(estimate: LogEstimate, monitor: Monitor, first: int, channel: int) -> list[Alarm]:
    """Alarms of the other channels if the filter runs without one."""
    turns = estimate.model.measured_turns
    left_out = np.array(of_channels(np.arange(estimate.model.m) == channel, turns))
    measurements = np.where(left_out, np.nan, estimate.log.measurements)
    again = estimate_with(estimate.filter, replace(estimate.log, measurements=measurements), noise=estimate.noise)
    gone = np.delete(left_out, [turn.stored for turn in turns])
    return [alarm for alarm in _alarms(again, monitor, first) if not gone[alarm.channel]]


def _statistical(alarms: Sequence[Alarm]) -> list[Alarm]:
    return [alarm for alarm in alarms if alarm.test not in ("stuck", "missing")]


def episodes(alarms: Sequence[Alarm], memory: int) -> list[list[Alarm]]:
    """Alarms of a channel that follow each other within `memory` steps, in the order of their first."""
    result: list[list[Alarm]] = []
    for alarm in alarms:
        last = next((episode for episode in reversed(result) if episode[-1].channel == alarm.channel), None)
        if last is not None and alarm.step - last[-1].step <= memory:
            last.append(alarm)
        else:
            result.append([alarm])
    return result


# An estimate of a log as columns of a file.


def columns_of(estimate: LogEstimate, alarms: LogAlarms | None = None) -> dict[str, np.ndarray]:
    """Columns (K + 1,) by header: time, inputs and measurements, then the filter's output, all by symbol.

    For a state or output "omega_m" headers are "omega_m_rad_per_s" and "omega_m_std_rad_per_s"; for a channel
    "thrust" "measured_thrust_N", "innovation_thrust_N" and "innovation_std_thrust_N"; for a reference
    "reference_T_N". With a monitor, "alarm_thrust" counts the tests that raise an alarm at a row.
    """
    log, model = estimate.log, estimate.model
    columns = {"time_s": log.start + log.times}
    for quantity, values in zip(log.input_quantities, log.input_rows.T, strict=True):
        columns[header_of("input", quantity)] = values
    for quantity, values in zip(log.measured, log.measurements.T, strict=True):
        columns[header_of("measured", quantity)] = values
    for quantity, values in compared(estimate).values():
        named, values = _in_degrees(quantity, estimate, values)
        columns[header_of("reference", named)] = values
    for quantity, mean, std in zip(model.states, estimate.means.T, estimate.stds.T, strict=True):
        columns[header_of("", quantity)], columns[header_of("std", quantity)] = mean, std
    for symbol, output in model.outputs.items():
        named, values = _in_degrees(output.quantity._replace(symbol=symbol), estimate, estimate.output(symbol))
        columns[header_of("", named)], columns[header_of("std", named)] = values
    deviations = np.sqrt(np.maximum(np.einsum("kii->ki", estimate.innovation_covs), 0.0))
    channels = estimate.innovation_quantities
    for quantity, values, std in zip(channels, estimate.innovations.T, deviations.T, strict=True):
        columns[header_of("innovation", quantity)], columns[header_of("innovation_std", quantity)] = values, std
    if alarms is not None:
        for channel, quantity in enumerate(log.measured):
            rows = [alarm.step for alarm in alarms.alarms if alarm.channel == channel]
            counts = np.bincount(rows, minlength=log.steps + 1)
            columns[header_of("alarm", quantity._replace(unit=""))] = counts.astype(np.float64)
    return columns


def header_of(what: str, quantity: Quantity) -> str:
    """The header of a column: "std_omega_m_rad_per_s"."""
    parts = (what, plain(quantity.symbol), suffix(quantity.unit))
    return "_".join(part for part in parts if part)


# How each filter is drawn: one colour and one dash, the same in every picture.

STYLES: dict[str, tuple[str, Any]] = {
    "kf": (PLUM, SOLID),
    "kf-steady": (PLUM, DOTTED),
    "ekf": (BLUE, SOLID),
    "iekf": (MUSTARD, DASHED),
    "ukf": (SKY, BOTH),
    "ckf": (WINE, DOTTED),
    "mhe": (WINE, TWO_DOTS),
    "enkf": (RUST, SOLID),
    "etkf": (SKY, DASHED),
    "letkf": (SKY, TWO_DOTS),
    "ensrf": (WINE, BOTH),
    "denkf": (MUSTARD, BOTH),
    "ienkf": (PLUM, BOTH),
    "enkf-n": (GREEN, TWO_DOTS),
    "rhf": (RUST, TWO_DOTS),
    "pf": (GREEN, SOLID),
    "apf": (GREEN, DASHED),
    "rbpf": (MUSTARD, TWO_DOTS),
    "gsf": (PLUM, DASHED),
    "fading": (RUST, DOTTED),
    "h-infinity": (RUST, DASHED),
    "schmidt": (SKY, DOTTED),
    "imm": (BLUE, DASHED),
    "mmae": (BLUE, DOTTED),
    "fuzzy": (MUSTARD, SOLID),
    "sage-husa": (GREEN, BOTH),
    "vb": (WINE, SOLID),
    "ekf-robust": (RUST, BOTH),
    "open-loop": (MUSTARD, DOTTED),
    "low-pass": (SKY, SOLID),
    "inversion": (WINE, DASHED),
}


def plot_style(name: str) -> dict[str, Any]:
    """Colour and dash of a filter by name, as matplotlib takes them; all estimators of one's own share one."""
    colour, dashes = STYLES.get(name, OTHER)
    return {"color": colour, "linestyle": dashes}


def colour_of(name: str) -> str:
    """Colour of a filter by name."""
    return STYLES.get(name, OTHER)[0]


def draw_log(estimate: LogEstimate, title: str, *, states: bool = True, alarms: LogAlarms | None = None) -> Figure:
    """Estimates beside the reference channels, and the innovations below; without `states` these alone.

    Measurements of a state or an output are dots. References come first; of many states and outputs the first six
    are drawn. Bands of the first rows, in which a filter settles from its prior, do not widen the axes. A line in
    the innovations marks the first alarm of an episode, which is shaded.
    """
    model, references, colour = estimate.model, compared(estimate), colour_of(estimate.filter.name)
    attitude = [f"{OUTPUT}:{symbol}" for symbol in euler_outputs(model.turns, model.states)]
    outputs = [key for symbol in model.outputs if (key := f"{OUTPUT}:{symbol}") not in attitude]
    values = [*attitude, *(f"{STATE}:{quantity.symbol}" for quantity in model.states), *outputs]
    turned = {
        f"{STATE}:{state.symbol}" for turn in model.turns for state in model.states[turn.quaternion]
    }  # of which roll, pitch and yaw say more
    plotted = sorted(values, key=lambda key: (key not in references, key in turned))[:MOST_PANELS]
    plotted = [key for key in values if key in plotted] if states else []
    channels = estimate.innovation_quantities
    heights = [TALL] * len(plotted) + [LOW if plotted else TALL] * len(channels)
    figure = new_figure((WIDTH, sum(heights) + ROOM))
    axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    tidy(axes)
    times = estimate.log.start + estimate.log.times
    labels = {f"{STATE}:{quantity.symbol}": quantity for quantity in model.states}
    labels |= {f"{OUTPUT}:{symbol}": output.quantity for symbol, output in model.outputs.items()}
    for axis, key in zip(axes, plotted, strict=False):
        mean, std = estimated(estimate, key)
        line = references[key][1] if key in references else mean
        line = wrapped(line) if labels[key].angle else line
        label, scale = _in_degrees(labels[key], estimate, 1.0)
        _limit(axis, scale * mean, scale * std, scale * line)
        breaks = with_breaks if labels[key].angle else lambda *lines: lines
        if key in references:
            line_times, line = breaks(times, line)
            axis.plot(line_times, scale * line, label="reference, not seen", **TRUTH)
        for measured in _measurements_of(estimate, mean):
            axis.scatter(times, scale * (wrapped(measured) if labels[key].angle else measured), **DOTS)
        own_times, mean, std = breaks(times, mean, std)
        mean, std, what = scale * mean, scale * std, "smoother" if estimate.smoothed else "estimate"
        _band(axis, own_times, mean, std, colour)
        axis.plot(own_times, mean, color=colour, linewidth=1.0, label=what)
        axis.set_ylabel(label.plot_label.replace(" $", "\n$"))
    for j, (axis, quantity) in enumerate(zip(axes[len(plotted) :], channels, strict=True)):
        std, innovation = np.sqrt(np.maximum(estimate.innovation_covs[:, j, j], 0.0)), estimate.innovations[:, j]
        rows, sparse = np.arange(len(times)), is_sparse(~np.isnan(innovation))
        if sparse:  # a line has no ends there, and S of the rows between is another one
            rows = np.flatnonzero(~np.isnan(innovation))
        _band(axis, times[rows], np.zeros(len(rows)), std[rows], colour)
        _limit(axis, np.zeros(len(rows)), std[rows], innovation[rows])
        style = SPARSE if sparse else {"linewidth": 0.8}
        axis.plot(times[rows], innovation[rows], color=colour, label="innovation", **style)
        for episode in episodes(alarms.alarms, alarms.monitor.memory) if alarms else ():
            if episode[0].channel == j:
                span = min(alarm.since for alarm in episode), episode[-1].step
                axis.axvspan(*times[list(span)], color=ALARM, alpha=0.2, linewidth=0, zorder=0)
                axis.axvline(times[episode[0].step], color=ALARM, linewidth=1.2, label="alarm")
        axis.set_ylabel(
            f"innovation of\n{quantity.symbol}" + (f"\n[{verbatim(quantity.unit)}]" if quantity.unit else "")
        )
    axes[0].set_title(verbatim(title, most=TITLE), fontsize=11)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    legend_below(figure, axes)
    return figure


def is_sparse(measured: np.ndarray) -> bool:
    """Whether most measured rows have none beside them that is, as those of a slow sensor."""
    near = np.pad(measured, 1)
    return bool(2 * (measured & ~near[:-2] & ~near[2:]).sum() > measured.sum())


def _measurements_of(estimate: LogEstimate, values: np.ndarray) -> list[np.ndarray]:
    """The measured channels whose component of h(x) equals a state or output, judged by some estimates."""
    model, rows = estimate.model, np.linspace(0, len(values) - 1, 40).astype(int)
    states = estimate.means[rows] if is_array(model.n) else [tuple(row) for row in estimate.means[rows].tolist()]
    try:
        inputs = inputs_until(estimate.log.inputs)[rows]
        fed = [model.any_shape.fed(as_value(u.tolist())) for u in inputs]
        h, c = model.functions.observe, model.given_constants
        expected = np.array([h(x, *u, c) for x, u in zip(states, fed, strict=True)])
    except (ValueError, ArithmeticError):  # of estimates at which h has no value, where Python raises
        return []
    same = np.isclose(expected, values[rows, None], rtol=1e-9, atol=1e-12, equal_nan=True).all(axis=0)
    signed = {j for turn in model.measured_turns for j in range(turn.stored, turn.stored + turn.size + 1)}
    return [estimate.log.measurements[:, j] for j in np.flatnonzero(same) if j not in signed]


def _band(axis, times: np.ndarray, middle: np.ndarray, std: np.ndarray, colour: str) -> None:
    low, high = middle - TWO_SIDED * std, middle + TWO_SIDED * std
    axis.fill_between(times, low, high, color=colour, alpha=0.25, linewidth=0, label="95 % band")


def _limit(axis, middle: np.ndarray, std: np.ndarray, line: np.ndarray) -> None:
    """Limit an axis to both lines and to the band after its first rows."""
    reach = TWO_SIDED * std[min(SKIPPED, len(std) // 4) :]
    ends = middle[len(std) - len(reach) :]
    limits = np.concatenate((middle, line, ends - reach, ends + reach))
    limits = limits[np.isfinite(limits)]
    if limits.size and np.ptp(limits) > 0.0:
        room = MARGIN * np.ptp(limits)
        axis.set_ylim(limits.min() - room, limits.max() + room)
