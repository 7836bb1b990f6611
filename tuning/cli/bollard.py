"""`thruster bollard`: a thruster from a static bollard table, and its time constants from a step."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.console import RenderableType

from thruster_env.core.text_tables import Table
from thruster_env.thruster.model import Recorder
from thruster_env.thruster.parameters import (
    PresetFile,
    ThrusterParameters,
    is_file,
    preset_parameters,
    write_preset,
)
from thruster_env.thruster.plant import make_plant
from tuning.api.identify import DEFAULT_OUT
from tuning.api.markers import INPUT, OUTPUT, READ, WRITTEN, Argument, Option, PresetOption
from tuning.api.result import Printed
from tuning.likelihood.identify import identify as identify_logs
from tuning.likelihood.result import Identification
from tuning.logs.read import read_named
from tuning.problems.problem import Parameter
from tuning.thruster.bollard import FITTED, Identified, identify, read_table, relative_errors
from tuning.thruster.logs import ThrusterFamily

INFERRED = "t200"  # whose other parameters are taken where no preset is given
MOTOR = ("motor_damping", "voltage_gain", "load_gain")  # whose ratios a table fixes
RATE = Parameter("motor_rate", 0.05, 20.0, default=1.0)  # the factor on all three


def command(
    path: Annotated[Path, Argument(INPUT, metavar="TABLE.csv", file=READ)],
    step: Annotated[Path | None, Option(INPUT, metavar="LOG", file=READ)] = None,
    column: Annotated[Sequence[str], Option(INPUT, metavar="NAME=HEADER[UNIT]")] = (),
    dt: Annotated[float | None, Option(INPUT)] = None,
    preset: Annotated[str | None, PresetOption] = None,
    out: Annotated[Path, Option(OUTPUT, file=WRITTEN)] = DEFAULT_OUT,
) -> Printed:
    """Identify a thruster from a bollard table, write its preset file, and say how well it fits.

    The table gives thrust, torque and speed in steady state; an optional step response how fast motor and flow
    follow. Everything else is that of the preset, t200 by default.

    Example: thruster bollard table.csv --step step.csv --column speed=motor_rpm --out mine.toml

    Args:
        path: table of pwm_us, rpm, current_A, voltage_V and force_kgf (docs/identify.md).
        step: a step response, for the time constants.
        column: the column of an input or measurement of the step response; may be repeated.
        dt: sample time [s] of a step response without times.
        preset: the thruster whose other parameters are taken:
        out: file for the result, a --preset for other commands.
    """
    if not is_file(out):
        raise ValueError(f"a preset file must end in .toml, but got {str(out)!r}")
    read = read_table(path)
    supplies = np.unique(read.supply).tolist()
    held_out = supplies[2:-1:2] or supplies[1:2]  # between others, so that nothing is extrapolated
    fit = identify(read, held_out, preset_parameters(preset or INFERRED))
    errors, parameters, timed = relative_errors(fit, read, held_out), fit.thruster, None
    if step is not None:
        timed, parameters = from_step(step, parameters, preset or INFERRED, columns=list(column) or None, dt=dt)
    identified = {
        "table": path.name,
        "held_out_supplies": held_out,
        **{name: float(value) for name, value in fit.pulse_widths._asdict().items()},
    }
    write_preset(out, PresetFile(parameters, identified=identified), "A thruster from its bollard table.")
    data = {
        "thruster": parameters._asdict(),
        "pulse_widths": fit.pulse_widths._asdict(),
        "held_out_supplies": held_out,
        "errors": errors,
        "step": timed and {"values": timed.values, "standard_errors": timed.standard_errors},
        "files": [str(out)],
    }
    return Printed(_report(fit, errors, held_out, timed, out), data)


def from_step(
    path: Path, parameters: ThrusterParameters, preset: str, **options
) -> tuple[Identification, ThrusterParameters]:
    """The motor's rate and the mass of the water from a step response, by maximum likelihood.

    Args:
        path: a log of the voltage and the motor's speed.
        parameters: from the table.
        preset: a thruster with the same quantities.
        **options: columns, clock offsets and the like, as `read_named` takes them.

    Raises:
        ValueError: if the log cannot be read, or the voltage does not change in it.
    """
    log, _ = read_named(path, preset, sensors=["speed"], **options)
    if not np.ptp(log.inputs):
        raise ValueError(f"a step response must have a step of the voltage, but {path} has none")
    largest = float(np.abs(log.inputs).max())
    plant = make_plant(parameters, log.dt, max_voltage=max(largest, 1.0), sensors=["speed"])
    family = ThrusterFamily([log], plant, Recorder(), (*MOTOR, "added_mass"))

    def values_of(motor_rate: float, **values: float) -> dict[str, float]:
        return {**{name: motor_rate * getattr(parameters, name) for name in MOTOR}, **values}

    def model(**values: float):
        return family.model(**values_of(**values))

    free = [RATE, *(parameter for parameter in family.free if parameter.name not in MOTOR)]
    identification = identify_logs(family.data, model, free)
    return identification, family.parameters(values_of(**identification.values))


def _report(
    fit: Identified, errors: dict, held_out, timed: Identification | None, out: Path
) -> list[RenderableType]:
    rows = [[name, f"{getattr(fit.thruster, name):.5g}"] for name in FITTED]
    rows += [[name, f"{value:.5g}"] for name, value in fit.pulse_widths._asdict().items()]
    part: list[RenderableType] = [Table("Fitted to the table", ["", "value"], rows)]
    rows = [
        [quantity, *(f"{e['median']:.1%} ({e['90 %']:.1%})" for group in groups.values() for e in group.values())]
        for quantity, groups in errors.items()
    ]
    columns = ["", "fitted\nahead", "fitted\nastern", "held out\nahead", "held out\nastern"]
    supplies = ", ".join(f"{supply:g}" for supply in held_out)
    title = f"Relative errors, median (90th percentile); held out: {supplies} V"
    part.append(Table(title, columns, rows))
    if timed is not None:
        rows = [[name, f"{timed.values[name]:.5g}", f"{timed.standard_errors[name]:.3g}"] for name in timed.names]
        part += [Table("From the step response", ["", "value", "standard error"], rows), *timed.sentences()]
    else:
        part.append(
            "A static table does not determine time constants: those of the preset are kept. --step LOG "
            "finds them from a log of voltage and motor speed."
        )
    return [*part, f"wrote {out}"]
