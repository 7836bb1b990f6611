"""An estimate of a log as columns of a file."""

from __future__ import annotations

import numpy as np

from filters.logs.alarms import LogAlarms
from filters.logs.estimate import LogEstimate
from filters.logs.findings import compared
from thruster_env.logs.columns import plain
from thruster_env.logs.units import suffix
from thruster_env.model.quantities import Quantity


def columns_of(found: LogEstimate, told: LogAlarms | None = None) -> dict[str, np.ndarray]:
    """Columns (K + 1,) by header: time, inputs and measurements, then the filter's output, all by symbol.

    Of a state or output "omega_m" it is "omega_m_rad_per_s" and "omega_m_std_rad_per_s"; of a channel "thrust"
    "measured_thrust_N", "innovation_thrust_N" and "innovation_std_thrust_N"; of a reference "reference_T_N". With
    a monitor "alarm_thrust" counts the tests that raise an alarm at a row.
    """
    log, model = found.log, found.model
    columns = {"time_s": log.start + log.times}
    for one, values in zip(log.input_quantities, log.inputs.T, strict=True):
        columns[header_of("input", one)] = np.append(values, np.nan)
    for one, values in zip(log.measured, log.measurements.T, strict=True):
        columns[header_of("measured", one)] = values
    for key in compared(found):
        columns[header_of("reference", log.referred[key])] = log.references[key]
    for one, mean, std in zip(model.states, found.means.T, found.stds.T, strict=True):
        columns[header_of("", one)], columns[header_of("std", one)] = mean, std
    for symbol, output in model.outputs.items():
        quantity = output.quantity._replace(symbol=symbol)
        columns[header_of("", quantity)], columns[header_of("std", quantity)] = found.output(symbol)
    deviations = np.sqrt(np.maximum(np.einsum("kii->ki", found.innovation_covs), 0.0))
    for one, values, std in zip(log.measured, found.innovations.T, deviations.T, strict=True):
        columns[header_of("innovation", one)], columns[header_of("innovation_std", one)] = values, std
    if told is not None:
        for channel, one in enumerate(log.measured):
            rows = [alarm.step for alarm in told.alarms if alarm.channel == channel]
            counts = np.bincount(rows, minlength=log.steps + 1)
            columns[header_of("alarm", one._replace(unit=""))] = counts.astype(np.float64)
    return columns


def header_of(what: str, quantity: Quantity) -> str:
    """The header of a column: "std_omega_m_rad_per_s"."""
    parts = (what, plain(quantity.symbol), suffix(quantity.unit))
    return "_".join(part for part in parts if part)
