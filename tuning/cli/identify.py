"""`thruster identify`: a thruster's parameters, or any model's, from recorded runs or a bollard table."""

from __future__ import annotations

import json as json_module
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import RenderableType
from rich.text import Text

from thruster_env.core.checks import finite, short_repr
from thruster_env.core.files import save_figure
from thruster_env.core.text_tables import table
from thruster_env.logs.log import Log
from thruster_env.logs.write import check_picture
from thruster_env.thruster.model import Recorder
from thruster_env.thruster.parameters import (
    PresetFile,
    ThrusterParameters,
    is_file,
    preset_parameters,
    write_preset,
)
from thruster_env.thruster.plant import make_plant
from tuning.api.identify import identified
from tuning.cli.options import (
    A_LOG,
    FILTER,
    INPUT,
    OUTPUT,
    SEARCH,
    GridOptions,
    HoldGapsOption,
    JsonOption,
    SeedOption,
    filter_option,
    with_groups,
)
from tuning.cli.output import announce_compilation, check_targets, emit, progress_console
from tuning.experiments.bollard import FITTED, Identified, identify, read_table, relative_errors
from tuning.identification.identify import STARTS
from tuning.identification.identify import identify as identify_logs
from tuning.identification.profiles import Profile, Validation, fall_sentence, profile_figure, profiles
from tuning.identification.result import Identification
from tuning.logs.problem import family_of, remarks, split_runs, write_found
from tuning.logs.read import pairs, read_named
from tuning.problems.problem import Parameter
from tuning.search.parameters import index_pairs
from tuning.thruster.logs import ThrusterFamily

# What `thruster identify` prints and writes.


def report(
    identification: Identification,
    checked: Mapping[str, Validation],
    runs: Sequence[Log],
    proving: Sequence[Log],
    files: Sequence[str],
) -> list[RenderableType]:
    """Tables and sentences for the terminal."""
    units = {parameter.name: parameter.unit for parameter in identification.objective.coordinates.free}
    rows = []
    for name in identification.names:
        known = "yes" if identification.determined[name] else "at the end" if identification.at_end[name] else "no"
        numbers = identification.start[name], identification.values[name], identification.standard_errors[name]
        test = identification.null_tests.get(name)
        without = ["-", "-"] if test is None else [f"{test.at:.4g}", test.said]
        label = index_pairs(name) + (f" [{units[name]}]" if units[name] else "")
        rows.append([label, *(f"{v:.5g}" for v in numbers), known, *without])
    count, steps = len(runs), sum(log.steps for log in runs)
    title = f"Identified on {count} run{'' if count == 1 else 's'}, {steps} steps"
    output = [table(title, ["", "start", "value", "standard\nerror", "determined", "if left\nout, at", "p"], rows)]
    where = (
        f"Validation on {'; '.join(log.name for log in proving)}"
        if proving
        else "On the runs used for identification"
    )
    rows = []
    for symbol in checked["start"].one_step:
        for what, part in (("one step", "one_step"), ("simulation", "simulation")):
            rows.append(
                [f"RMSE, {what}, {symbol}", *(f"{getattr(v, part)[symbol]:.4g}" for v in checked.values())]
            )
        rows.append([f"fit of the simulation, {symbol} [%]", *(f"{v.fit[symbol]:.1f}" for v in checked.values())])
    rows.append(["mean NIS over channels", *(f"{v.nis:.3g}" for v in checked.values())])
    rows.append(["log-likelihood", *(f"{v.log_likelihood:.6g}" for v in checked.values())])
    output.append(table(where, ["", *checked], rows))
    return [
        *output,
        *identification.sentences(),
        *(fall_sentence(checked) if proving else []),
        *remarks(runs, proving, identification),
        *(f"wrote {path}" for path in files),
    ]


def write_files(
    identification: Identification,
    family,
    curves: Sequence[Profile],
    out: Path | None,
    plot: Path | None,
    logs: Sequence[str],
) -> list[str]:
    """Write the preset file of a thruster or the values of a model, and the profiles; return the paths."""
    files = []
    if out is not None:
        write_found(out, identification, family, logs)
        files.append(str(out))
    if plot is not None and curves:
        save_figure(profile_figure(identification, curves), plot)
        files.append(str(plot))
    return files


def as_json(
    identification: Identification,
    checked: Mapping[str, Validation],
    curves: Sequence[Profile],
    runs: Sequence[Log],
    proving: Sequence[Log],
    files: Sequence[str],
) -> dict:
    """The result as plain data."""
    return {
        "logs": [log.name for log in runs],
        "held_out": [log.name for log in proving],
        "values": identification.values,
        "start": identification.start,
        "standard_errors": identification.standard_errors,
        "determined": identification.determined,
        "at_end": identification.at_end,
        "left_out": {name: test._asdict() for name, test in identification.null_tests.items()},
        "begun_elsewhere": [runs[i].name for i in identification.begun_elsewhere],
        "correlations": {"names": identification.names, "matrix": identification.correlations},
        "trade_off": identification.traded,
        "least_known_direction": identification.least_determined,
        "log_likelihood": identification.log_likelihood,
        "log_likelihood_at_start": identification.start_log_likelihood,
        "optima": [optimum._asdict() for optimum in identification.optima],
        "starts_that_agree": identification.agreement,
        "evaluations": identification.evaluations,
        "samples_left_out": identification.left_out,
        "interrupted": identification.interrupted,
        "validation": {name: validation._asdict() for name, validation in checked.items()},
        "profiles": [{**profile._asdict(), "interval": profile.interval} for profile in curves],
        "sentences": [
            *identification.sentences(),
            *(fall_sentence(checked) if proving else []),
            *remarks(runs, proving, identification),
        ],
        "files": list(files),
    }


# Options of an identification from the command line: ranges, starts and names.


def ranges_of(texts: Mapping[str, str]) -> dict[str, tuple[float, float]]:
    """Ranges from texts LOW:HIGH; ValueError for another form."""
    ranges = {}
    for name, text in texts.items():
        low, colon, high = text.partition(":")
        if not colon:
            raise ValueError(f"--range must have the form NAME=LOW:HIGH, but got {short_repr(f'{name}={text}')}")
        ranges[name] = finite(f"low of {name}", low), finite(f"high of {name}", high)
    return ranges


def numbers_of(option: str, texts: Mapping[str, str]) -> dict[str, float]:
    """Numbers by name."""
    return {name: finite(f"{option} {name}", text) for name, text in texts.items()}


def names_of(text: str | None) -> list[str]:
    """Names from a text separated by commas."""
    return [name.strip() for name in (text or "").split(",") if name.strip()]


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
    outcome = identified(
        family, runs, proving, ranges, numbers, progress_console, filter=filter_name, seed=seed, **search
    )
    identification, checked, curves = outcome.found, outcome.validation, []
    if plot is not None and not identification.interrupted:
        with progress_console.status("profiles ...") as status:
            curves = profiles(identification, progress=lambda name: status.update(Text(f"profile of {name} ...")))
    files = write_files(identification, family, curves, out, plot, [log.name for log in runs])
    data = as_json(identification, checked, curves, runs, proving, files)
    emit(report(identification, checked, runs, proving, files), data, json)
    if identification.interrupted:
        sys.exit(INTERRUPTED)


# `thruster identify --bollard TABLE.csv`: a thruster from a static table, and its time constants from a step.


INFERRED = "t200"  # whose other parameters are taken where no preset is given
MOTOR = ("motor_damping", "voltage_gain", "load_gain")  # whose ratios a table fixes
RATE = Parameter("motor_rate", 0.05, 20.0, default=1.0)  # the factor on all three


def identify_bollard(
    path: Path,
    step: Path | None,
    logs: Sequence[Path] | None,
    preset: str | None,
    out: Path,
    json: str | None,
    **options,
) -> None:
    """Identify a thruster from a bollard table, write its preset file, and say how well it fits.

    The table gives thrust, torque and speed in steady state; an optional step response how fast motor and flow
    follow. Everything else is taken from a preset.

    Args:
        path: the table, with the columns pwm_us, rpm, current_A, voltage_V, force_kgf.
        step: a log of voltage and motor speed.
        logs: must be none.
        preset: whose other parameters are taken.
        out: the preset file.
        json: file for the result as JSON.
        **options: how the step response is read, as `read_named` takes them.

    Raises:
        ValueError: states the rule and the value.
    """
    if logs:
        raise ValueError(f"give either logs or --bollard TABLE.csv, but got both, {logs[0]} and {path}")
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
        timed, parameters = from_step(step, parameters, preset or INFERRED, **options)
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


def check_of_table(for_logs: Mapping[str, Any]) -> None:
    """Raise ValueError for an option of logs if a table is given in their place.

    Args:
        for_logs: values of such options by name, empty or false where they are not given.
    """
    for name, value in for_logs.items():
        if value:
            got = "" if value is True else f" {', '.join(map(str, value)) if isinstance(value, list) else value}"
            raise ValueError(f"{name} must come with logs, because --bollard fits a table, but got {name}{got}")


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
