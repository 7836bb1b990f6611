"""`thruster bollard`: a thruster from a static bollard table, and its time constants from a step."""

from __future__ import annotations

import json as json_module
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import RenderableType

from thruster_env.core.text_tables import table
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
from tuning.cli.options import INPUT, OUTPUT, ColumnOption, JsonOption, LogPresetOption
from tuning.cli.output import announce_compilation, check_targets, emit
from tuning.experiments.bollard import FITTED, Identified, identify, read_table, relative_errors
from tuning.identification.identify import identify as identify_logs
from tuning.identification.result import Identification
from tuning.logs.read import read_named
from tuning.problems.problem import Parameter
from tuning.thruster.logs import ThrusterFamily

INFERRED = "t200"  # whose other parameters are taken where no preset is given
MOTOR = ("motor_damping", "voltage_gain", "load_gain")  # whose ratios a table fixes
RATE = Parameter("motor_rate", 0.05, 20.0, default=1.0)  # the factor on all three


def command(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="TABLE.csv",
            help="Table of pwm_us, rpm, current_A, voltage_V and force_kgf (docs/identify.md).",
        ),
    ],
    step: Annotated[
        Path | None,
        typer.Option(metavar="LOG", help="A step response, for the time constants.", rich_help_panel=INPUT),
    ] = None,
    column: ColumnOption = None,
    dt: Annotated[
        float | None, typer.Option(help="Sample time [s] of a step response without times.", rich_help_panel=INPUT)
    ] = None,
    preset: LogPresetOption = None,
    out: Annotated[
        Path, typer.Option(help="File for the result, a --preset for other commands.", rich_help_panel=OUTPUT)
    ] = DEFAULT_OUT,
    json: JsonOption = None,
) -> None:
    """Identify a thruster from a bollard table, write its preset file, and say how well it fits.

    The table gives thrust, torque and speed in steady state; an optional step response how fast motor and flow
    follow. Everything else is that of the preset, t200 by default.

    Example: thruster bollard table.csv --step step.csv --column speed=motor_rpm --out mine.toml
    """
    if not is_file(out):
        raise ValueError(f"a preset file must end in .toml, but got {str(out)!r}")
    check_targets((out,), json, read=(path, step, preset))
    read = read_table(path)
    supplies = np.unique(read.supply).tolist()
    held_out = supplies[2:-1:2] or supplies[1:2]  # between others, so that nothing is extrapolated
    fit = identify(read, held_out, preset_parameters(preset or INFERRED))
    errors, parameters, timed = relative_errors(fit, read, held_out), fit.thruster, None
    if step is not None:
        announce_compilation()
        timed, parameters = from_step(step, parameters, preset or INFERRED, columns=column, dt=dt)
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
    emit(_report(fit, errors, held_out, timed, out), json_module.loads(json_module.dumps(data)), json)


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
    part: list[RenderableType] = [table("Fitted to the table", ["", "value"], rows)]
    rows = [
        [quantity, *(f"{e['median']:.1%} ({e['90 %']:.1%})" for group in groups.values() for e in group.values())]
        for quantity, groups in errors.items()
    ]
    columns = ["", "fitted\nahead", "fitted\nastern", "held out\nahead", "held out\nastern"]
    supplies = ", ".join(f"{supply:g}" for supply in held_out)
    title = f"Relative errors, median (90th percentile); held out: {supplies} V"
    part.append(table(title, columns, rows))
    if timed is not None:
        rows = [[name, f"{timed.values[name]:.5g}", f"{timed.standard_errors[name]:.3g}"] for name in timed.names]
        part += [table("From the step response", ["", "value", "standard error"], rows), *timed.sentences()]
    else:
        part.append(
            "A static table does not determine time constants: those of the preset are kept. --step LOG "
            "finds them from a log of voltage and motor speed."
        )
    return [*part, f"wrote {out}"]
