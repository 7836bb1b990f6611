"""`thruster identify`: a thruster's parameters, or any model's, from recorded runs or a bollard table."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated

import typer

from thruster_cli.identified import as_json, report, write_files
from thruster_cli.logs import (
    ClockOption,
    ColumnOption,
    DtOption,
    LogPresetOption,
    ModelOption,
    SensorOption,
    pairs,
)
from thruster_cli.output import JsonOption, SeedOption, announce_compilation, check_targets, emit, progress_console
from thruster_cli.to_identify import names_of, numbers_of, ranges_of
from thruster_env.preset_file import is_file
from tuning.identification.coordinates import Coordinates
from tuning.identification.excitation import check_excitation
from tuning.identification.family import with_ranges
from tuning.identification.identify import STARTS, identify
from tuning.identification.objective import Objective
from tuning.identification.profiles import profiles
from tuning.identification.validation import validate
from tuning.logs.identify import check_offsets, family_of, split_runs

INTERRUPTED = 130
DEFAULT_OUT = Path("out/identified.toml")


def command(
    logs: Annotated[
        list[Path] | None, typer.Argument(metavar="LOG...", help="Recorded runs, .csv, .parquet or .npz.")
    ] = None,
    free: Annotated[
        str | None,
        typer.Option(help="Names of what is to be found, with commas between; a wrong one lists those known."),
    ] = None,
    preset: LogPresetOption = None,
    model: ModelOption = None,
    sensor: SensorOption = None,
    column: ColumnOption = None,
    clock_offset: ClockOption = None,
    dt: DtOption = None,
    range_: Annotated[
        list[str] | None,
        typer.Option("--range", metavar="NAME=LOW:HIGH", help="Within which one is looked for; may be repeated."),
    ] = None,
    start: Annotated[
        list[str] | None, typer.Option("--start", metavar="NAME=VALUE", help="Where the search begins.")
    ] = None,
    hold_noise: Annotated[
        bool, typer.Option("--hold-noise", help="Leave Q and R as they are; else their variances are found, too.")
    ] = False,
    held_out: Annotated[
        list[Path] | None,
        typer.Option("--held-out", help="Run that only validates; by default every third of three or more."),
    ] = None,
    use_all: Annotated[bool, typer.Option("--use-all", help="Hold no run out.")] = False,
    filter_name: Annotated[str, typer.Option("--filter", help="ekf, or kf for affine models.")] = "ekf",
    predicted: Annotated[
        list[str] | None,
        typer.Option(
            metavar="CHANNEL", help="The filter predicts it but never sees it, such as a load cell's thrust."
        ),
    ] = None,
    degrees: Annotated[
        float,
        typer.Option(help="Of freedom of Student-t errors, such as 20, of predicted channels, if there are any."),
    ] = math.inf,
    gate: Annotated[
        float, typer.Option(help="Leave out samples beyond so many standard deviations, such as 5, as outliers.")
    ] = math.inf,
    starts: Annotated[int, typer.Option(help="Searches from so many starts.")] = STARTS,
    bollard: Annotated[
        Path | None,
        typer.Option(metavar="TABLE.csv", help="In place of logs: a static bollard table (docs/identify.md)."),
    ] = None,
    step: Annotated[
        Path | None, typer.Option(metavar="LOG", help="With --bollard: a step response, for the time constants.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help=f"File of what is found, for --preset of other commands; {DEFAULT_OUT}.")
    ] = None,
    plot: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Profile likelihoods.")] = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
) -> None:
    """Find the parameters under which recorded runs are most likely, and say which of them the runs determine.

    Of a thruster may be free: its parameters (motor_damping, voltage_gain, ...), dead_band or dead_band_low and
    dead_band_high, thrust_asymmetry, ambient_velocity, bias_CHANNEL, lag_CHANNEL, clock_offset_CHANNEL, and the
    variances of Q and R. Of a --model, the arguments that have numbers for defaults, and its named constants.

    With --predicted what is found is what predicts that channel best for a filter that does not have it: --sensor
    speed --sensor thrust --predicted thrust identifies on a stand what will estimate thrust on the ship.

    The file that comes out is the --preset of other commands, of a thruster also of gym.make(preset=...); with
    --model it holds the numbers of that model. Ctrl-C keeps the best so far.

    Example: thruster identify run*.csv --preset tunnel --free motor_damping,voltage_gain,dead_band

    Example: thruster identify run.csv --model my_module:model --free stiffness,damping --range damping=0:2
    """
    if plot is not None and plot.suffix != ".png":
        raise ValueError(f"--plot must end in .png, but got {str(plot)!r}")
    if bollard is not None:
        from thruster_cli.bollard import identify_bollard

        reading = {"columns": column, "clock_offset": clock_offset, "dt": dt}
        return identify_bollard(bollard, step, logs, preset, out or DEFAULT_OUT, json, **reading)
    if step is not None:
        raise ValueError("--step must come with --bollard TABLE.csv, but got it alone")
    whose = {"preset": preset, "model": model, "sensors": sensor}
    options = whose | {"columns": column, "clock_offset": clock_offset, "dt": dt}
    if not logs:
        raise ValueError("identify must have at least one log, or --bollard TABLE.csv, but got none")
    out = out or DEFAULT_OUT
    runs, proving = split_runs(logs, held_out, use_all=use_all, **options)
    family = family_of(runs, names_of(free), **whose, noise=not hold_noise, filter=filter_name)
    numbers, ranges = numbers_of("--start", pairs("--start", start)), ranges_of(pairs("--range", range_))
    parameters = with_ranges(family.free, ranges, numbers)
    check_offsets(parameters, runs)
    if out is not None and not is_file(out):
        raise ValueError(f"--out must end in .toml, but got {str(out)!r}")
    check_targets((out, plot), json, read=(*logs, *(held_out or [])))
    announce_compilation()
    coordinates = Coordinates(parameters)
    objective = Objective(family.data, family.model, coordinates, filter=filter_name, predicted=predicted or ())
    check_excitation(objective, runs, coordinates.start())
    with progress_console.status("identifying ...") as status:

        def tell(number: int, value: float, values: dict) -> None:
            status.update(f"start {number + 1} of {starts}: log-likelihood {value:.2f}")

        found = identify(
            family.data,
            family.model,
            parameters,
            filter=filter_name,
            starts=starts,
            seed=seed,
            gate=gate,
            degrees=degrees,
            predicted=predicted or (),
            progress=tell,
        )
        made = []
        if plot is not None and not found.interrupted:
            made = profiles(found, progress=lambda name: status.update(f"profile of {name} ..."))
    checked = validate(found, family.shifted(proving)) if proving else validate(found)
    files = write_files(found, family, made, out, plot, [log.name for log in runs])
    data = as_json(found, checked, made, runs, proving, files)
    emit(report(found, checked, runs, proving, files), data, json)
    if found.interrupted:
        sys.exit(INTERRUPTED)
