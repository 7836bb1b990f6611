"""`thruster bollard`: a thruster and its speed controller from a static bollard table, its rates from a step."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.console import RenderableType

from thruster_env.core.text_tables import Table
from thruster_env.thruster.parameters import PresetFile, is_file, preset_parameters, write_preset
from tuning.api.identify import DEFAULT_OUT
from tuning.api.markers import INPUT, OUTPUT, READ, WRITTEN, Argument, Option, PresetOption
from tuning.api.result import Printed
from tuning.likelihood.result import Identification
from tuning.plants.bollard import FITTED, Identified, from_step, identify_bollard, read_bollard, relative_errors

INFERRED = "t200"  # whose other parameters are taken where no preset is given


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
    read = read_bollard(path)
    supplies = np.unique(read.supply).tolist()
    held_out = supplies[2:-1:2] or supplies[1:2]  # between others, so that nothing is extrapolated
    fit = identify_bollard(read, held_out, preset_parameters(preset or INFERRED))
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
