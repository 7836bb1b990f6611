"""`thruster identify`: a thruster's parameters, or any model's, from recorded runs or a bollard table."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text

from thruster_env.thruster.preset_file import is_file
from tuning.api.identify import identified
from tuning.cli.identified import as_json, report, write_files
from tuning.cli.log_options import GridOptions, with_groups
from tuning.cli.options import (
    A_LOG,
    FILTER,
    INPUT,
    OUTPUT,
    SEARCH,
    HoldGapsOption,
    JsonOption,
    SeedOption,
    filter_option,
)
from tuning.cli.output import announce_compilation, check_picture, check_targets, emit, progress_console
from tuning.cli.to_identify import names_of, numbers_of, ranges_of
from tuning.identification.identify import STARTS
from tuning.identification.profiles import profiles
from tuning.logs.identify import family_of, split_runs
from tuning.logs.read import pairs

INTERRUPTED = 130
DEFAULT_OUT = Path("out/identified.toml")


@with_groups
def command(
    logs: Annotated[list[Path] | None, typer.Argument(metavar="LOG...", help=f"Recorded runs. {A_LOG}")] = None,
    free: Annotated[
        str | None,
        typer.Option(
            help="Names of the free parameters, separated by commas; a wrong name lists the known ones.",
            rich_help_panel=SEARCH,
        ),
    ] = None,
    *,
    reading: GridOptions,
    range_: Annotated[
        list[str] | None,
        typer.Option(
            "--range",
            metavar="NAME=LOW:HIGH",
            help="Range of a parameter; may be repeated.",
            rich_help_panel=SEARCH,
        ),
    ] = None,
    start: Annotated[
        list[str] | None,
        typer.Option("--start", metavar="NAME=VALUE", help="Where the search begins.", rich_help_panel=SEARCH),
    ] = None,
    hold_noise: Annotated[
        bool,
        typer.Option(
            "--hold-noise",
            help="Keep Q and R fixed; by default their variances are free, too.",
            rich_help_panel=SEARCH,
        ),
    ] = False,
    held_out: Annotated[
        list[Path] | None,
        typer.Option(
            "--held-out",
            help="Run used only for validation; by default every third of three or more.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    use_all: Annotated[bool, typer.Option("--use-all", help="Hold out no run.", rich_help_panel=INPUT)] = False,
    hold_gaps: HoldGapsOption = False,
    filter_name: Annotated[str, filter_option("ekf, or kf for affine models.")] = "ekf",
    predicted: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CHANNEL",
            help="A channel that the filter predicts but never sees, such as a load cell's thrust.",
            rich_help_panel=FILTER,
        ),
    ] = None,
    degrees: Annotated[
        float,
        typer.Option(
            help="Degrees of freedom of Student-t errors, such as 20; of the predicted channels, if any.",
            rich_help_panel=SEARCH,
        ),
    ] = math.inf,
    gate: Annotated[
        float,
        typer.Option(
            help="Leave out samples beyond so many standard deviations, such as 5, as outliers.",
            rich_help_panel=SEARCH,
        ),
    ] = math.inf,
    starts: Annotated[int, typer.Option(help="Number of starts of the search.", rich_help_panel=SEARCH)] = STARTS,
    bollard: Annotated[
        Path | None,
        typer.Option(
            metavar="TABLE.csv",
            help="In place of logs: a static bollard table (docs/identify.md).",
            rich_help_panel=INPUT,
        ),
    ] = None,
    step: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG", help="With --bollard: a step response, for the time constants.", rich_help_panel=INPUT
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help=f"File for the result, a --preset for other commands; {DEFAULT_OUT}.", rich_help_panel=OUTPUT
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Profile likelihoods, .png, .svg or .pdf.", rich_help_panel=OUTPUT),
    ] = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
) -> None:
    """Find the maximum-likelihood parameters for recorded runs, and say which of them the runs determine.

    The free parameters of a thruster may be its constants (motor_damping, voltage_gain, ...), dead_band or
    dead_band_low and dead_band_high, thrust_asymmetry, ambient_velocity, bias_CHANNEL, lag_CHANNEL,
    clock_offset_CHANNEL, and the variances of Q and R; of a --model, the arguments with numeric defaults and its
    named constants.

    With --predicted the result predicts that channel best for a filter that does not see it: --sensor speed
    --sensor thrust --predicted thrust identifies, on a test stand, a model that estimates thrust on the ship.

    The output is a --preset for other commands, for a thruster also for gym.make(preset=...); with --model
    it contains the values of that model. Ctrl-C keeps the best so far.

    Example: thruster identify run*.csv --preset tunnel --free motor_damping,voltage_gain,dead_band

    Example: thruster identify run.csv --model my_module:model --free stiffness,damping --range damping=0:2
    """
    if plot is not None:
        check_picture(plot, "--plot")
    if bollard is not None:
        from tuning.cli.bollard import check_of_table, identify_bollard

        for_logs: dict[str, Any] = {
            "--free": free,
            "--model": reading.model,
            "--sensor": reading.sensor,
            "--range": range_,
        }
        for_logs |= {"--start": start, "--hold-noise": hold_noise, "--no-grid": reading.no_grid}
        for_logs |= {"--stamps": reading.stamps}
        for_logs |= {"--held-out": held_out, "--use-all": use_all, "--plot": plot, "--predicted": predicted}
        check_of_table(for_logs)
        of_step = {"columns": reading.column, "clock_offset": reading.clock_offset, "dt": reading.dt}
        return identify_bollard(bollard, step, logs, reading.preset, out or DEFAULT_OUT, json, **of_step)
    if step is not None:
        raise ValueError(f"--step must come with --bollard TABLE.csv, but got --step {step} alone")
    if not logs:
        raise ValueError("identify must have at least one log, or --bollard TABLE.csv, but got none")
    out = out or DEFAULT_OUT
    runs, proving = split_runs(logs, held_out, use_all=use_all, hold_gaps=hold_gaps, **reading.named())
    plant: dict[str, Any] = {"preset": reading.preset, "model": reading.model, "sensors": reading.sensor}
    family = family_of(runs, names_of(free), **plant, noise=not hold_noise, filter=filter_name)
    numbers, ranges = numbers_of("--start", pairs("--start", start)), ranges_of(pairs("--range", range_))
    if out is not None and not is_file(out):
        raise ValueError(f"--out must end in .toml, but got {str(out)!r}")
    check_targets((out, plot), json, read=(*logs, *(held_out or []), reading.preset))
    announce_compilation()
    search: dict[str, Any] = {"gate": gate, "degrees": degrees, "predicted": predicted or (), "starts": starts}
    whole = identified(
        family, runs, proving, ranges, numbers, progress_console, filter=filter_name, seed=seed, **search
    )
    found, checked, made = whole.found, whole.validation, []
    if plot is not None and not found.interrupted:
        with progress_console.status("profiles ...") as status:
            made = profiles(found, progress=lambda name: status.update(Text(f"profile of {name} ...")))
    files = write_files(found, family, made, out, plot, [log.name for log in runs])
    data = as_json(found, checked, made, runs, proving, files)
    emit(report(found, checked, runs, proving, files), data, json)
    if found.interrupted:
        sys.exit(INTERRUPTED)
