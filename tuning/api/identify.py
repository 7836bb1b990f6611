"""`tuning.identify` and `thruster identify`: a thruster's parameters, or any model's, from recorded runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from rich.text import Text

from thruster_env.core.checks import finite, short_repr
from thruster_env.core.files import save_figure
from thruster_env.core.parallel import task_map
from thruster_env.core.text_tables import Table
from thruster_env.logs.log import Log
from thruster_env.logs.write import check_picture
from thruster_env.model.state_space import StateSpaceModel
from tuning.api.markers import (
    FILTER,
    LOGS,
    OUTPUT,
    READ,
    SEARCH,
    WRITTEN,
    ExecutorOption,
    FilterOption,
    LogsArgument,
    Option,
    Progress,
    Seed,
    WrittenFile,
)
from tuning.api.progress import console_for
from tuning.api.read_logs import recorded_runs
from tuning.api.result import Result, drawn, frame, plain_data
from tuning.likelihood.identify import STARTS, Profile, Validation, profile_figure, profiles, validate
from tuning.likelihood.identify import identify as identify_runs
from tuning.likelihood.objective import Objective
from tuning.likelihood.parametric import ModelFamily
from tuning.likelihood.recorded import CLOCK, likelihood_of
from tuning.likelihood.result import Identification, covariance, is_narrow, write_values
from tuning.logs.problem import AnyStepFamily, family_of, remarks, split_runs
from tuning.logs.read import pairs
from tuning.problems.find import logs_package
from tuning.problems.problem import Coordinates, Parameter
from tuning.search.parameters import index_pairs

DEFAULT_OUT = Path("out/identified.toml")  # of the command
OFFSET_SHARE = 4  # a clock offset may be at most the length of a log divided by this
RANGE, START = "ranges (--range)", "start (--start)"

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


def fall_sentence(checked: Mapping[str, Validation]) -> list[str]:
    """A sentence if the log-likelihood of held-out runs fell, in a list; empty if it did not.

    Args:
        checked: from `validate`, on held-out runs.
    """
    start, identified = checked["start"].log_likelihood, checked["identified"].log_likelihood
    if not identified < start:
        return []
    return [
        f"On the held-out runs the log-likelihood fell by {start - identified:.3g}: there the identified values "
        "predict no better than those at the start."
    ]


@dataclass(frozen=True, eq=False, repr=False)
class Identified(Result):
    """Maximum-likelihood values of free parameters, their uncertainty, and the model's errors on other runs.

    Attributes:
        found: the identification itself.
        validation: of the model at the "start" and "identified", on the held-out runs, or else on the same runs.
        family: the thruster or the model whose parameters are free.
        runs: runs used for identification.
        held_out: runs used only for validation.
        curves: profile likelihoods, if a picture of them was asked for.
        files: that were written.
    """

    found: Identification
    validation: Mapping[str, Validation]
    family: Any
    runs: tuple[Log, ...]
    held_out: tuple[Log, ...] = ()
    curves: tuple[Profile, ...] = ()
    files: tuple[str, ...] = ()

    @property
    def values(self) -> dict[str, float]:
        """Values by name."""
        return self.found.values

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard errors of the values by name."""
        return self.found.standard_errors

    @property
    def determined(self) -> dict[str, bool]:
        """Whether the runs determine each value."""
        return self.found.determined

    @property
    def correlations(self) -> np.ndarray:
        """Of the estimates, (p, p), in the order of the values."""
        return self.found.correlations

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended it: the values are the best so far."""
        return self.found.interrupted

    @property
    def model(self) -> StateSpaceModel:
        """The model with the identified values, as the filter used it; on own stamps that of a step of dt."""
        if isinstance(self.family, AnyStepFamily):
            return self.family.plain.model(**self.values)
        return self.found.objective.model_at(self.found.at)

    def sentences(self) -> list[str]:
        """Which parameters the data determine, whether held-out runs say so, and the findings in the logs."""
        fell = fall_sentence(self.validation) if self.held_out else []
        return [*self.found.sentences(), *fell, *remarks(self.runs, self.held_out, self.found)]

    def to_frame(self) -> pandas.DataFrame:
        """A row per parameter: unit, start, value, standard error, whether the data determine it, and a test.

        "p" is the probability of so large a fall of the likelihood if "left out at" were the parameter's true
        value: zero if its range contains zero, otherwise the start.

        Raises:
            ValueError: if pandas is not installed.
        """
        names, tests = self.found.names, self.found.null_tests
        columns: dict[str, Sequence[Any]] = {
            "parameter": list(names),
            "unit": [parameter.unit for parameter in self.found.objective.coordinates.free],
            "start": [self.found.start[name] for name in names],
            "value": [self.values[name] for name in names],
            "standard error": [self.standard_errors[name] for name in names],
            "determined": [self.determined[name] for name in names],
            "left out at": [tests[name].at if name in tests else math.nan for name in names],
            "p": [tests[name].p if name in tests else math.nan for name in names],
        }
        return frame(columns, "parameter")

    def save(self, path: str | Path) -> Path:
        """Write the result to a file, a `preset` for other calls and commands; return the path.

        Of a thruster it is a preset file, which `gym.make(preset=...)` takes, too; of another model its numbers.

        Raises:
            ValueError: if the path does not end in .toml, or the file cannot be written.
        """
        write_found(path, self.found, self.family, [log.name for log in self.runs])
        return Path(path)

    def plot_profiles(self, names: Sequence[str] | None = None) -> Figure:
        """Profile likelihoods: the fall of the log-likelihood if one parameter is held at another value.

        Args:
            names: of the parameters; all if None. Each takes some searches.

        Raises:
            ValueError: for an unknown name.
        """
        return drawn(profile_figure(self.found, profiles(self.found, names)))

    @property
    def title(self) -> str:
        """The number of runs."""
        count, steps = len(self.runs), sum(log.steps for log in self.runs)
        return f"Identified on {count} run{'' if count == 1 else 's'}, {steps} steps"

    def figures(self) -> dict[str, Figure]:
        """Profile likelihoods, if they were asked for."""
        return {"Profile likelihoods": profile_figure(self.found, self.curves)} if self.curves else {}

    def tables(self) -> list[Table | str]:
        """The parameters, the validation and what the runs determine, for a terminal."""
        heads = ["", "start", "value", "standard\nerror", "determined", "if left\nout, at", "p"]
        tests, labels = self.found.null_tests, []
        units = {parameter.name: parameter.unit for parameter in self.found.objective.coordinates.free}
        for name, value in self.values.items():
            known = "yes" if self.determined[name] else "at the end" if self.found.at_end[name] else "no"
            test = tests.get(name)
            numbers = [f"{number:.5g}" for number in (self.found.start[name], value, self.standard_errors[name])]
            without = ["-", "-"] if test is None else [f"{test.at:.4g}", test.said]
            label = index_pairs(name) + (f" [{units[name]}]" if units[name] else "")
            labels.append([label, *numbers, known, *without])
        where = "On the runs used for identification"
        if self.held_out:
            where = f"Validation on {'; '.join(log.name for log in self.held_out)}"
        checked, rows = self.validation, []
        for symbol in checked["start"].one_step:
            for what, part in (("one step", "one_step"), ("simulation", "simulation")):
                errors = [f"{getattr(check, part)[symbol]:.4g}" for check in checked.values()]
                rows.append([f"RMSE, {what}, {symbol}", *errors])
            fits = [f"{check.fit[symbol]:.1f}" for check in checked.values()]
            rows.append([f"fit of the simulation, {symbol} [%]", *fits])
        rows.append(["mean NIS over channels", *(f"{check.nis:.3g}" for check in checked.values())])
        rows.append(["log-likelihood", *(f"{check.log_likelihood:.6g}" for check in checked.values())])
        tables = [Table(self.title, heads, labels), Table(where, ["", *checked], rows)]
        return [*tables, *self.sentences(), *(f"wrote {path}" for path in self.files)]

    def as_dict(self) -> dict[str, Any]:
        """All results as plain data, as in `thruster identify --json`."""
        result = self.found
        data = {
            "logs": [log.name for log in self.runs],
            "held_out": [log.name for log in self.held_out],
            "values": result.values,
            "start": result.start,
            "standard_errors": result.standard_errors,
            "determined": result.determined,
            "at_end": result.at_end,
            "left_out": {name: test._asdict() for name, test in result.null_tests.items()},
            "begun_elsewhere": [self.runs[i].name for i in result.begun_elsewhere],
            "correlations": {"names": result.names, "matrix": result.correlations},
            "trade_off": result.traded,
            "least_known_direction": result.least_determined,
            "log_likelihood": result.log_likelihood,
            "log_likelihood_at_start": result.start_log_likelihood,
            "optima": [optimum._asdict() for optimum in result.optima],
            "starts_that_agree": result.agreement,
            "evaluations": result.evaluations,
            "samples_left_out": result.left_out,
            "interrupted": result.interrupted,
            "validation": {name: check._asdict() for name, check in self.validation.items()},
            "profiles": [{**profile._asdict(), "interval": profile.interval} for profile in self.curves],
            "sentences": self.sentences(),
            "files": list(self.files),
        }
        return plain_data(data)

    def __repr__(self) -> str:
        values = ", ".join(f"{name} {value:.4g}" for name, value in list(self.values.items())[:6])
        more = ", ..." if len(self.values) > 6 else ""
        loose = sum(not known for known in self.determined.values())
        verdict = f"{loose} of {len(self.values)} not determined" if loose else "all determined"
        return f"Identified({values}{more}; {verdict}, {len(self.runs)} runs)"


def with_ranges(
    free: Sequence[Parameter], ranges: Mapping[str, tuple[float, float]], start: Mapping[str, float]
) -> tuple[Parameter, ...]:
    """Free parameters with other ranges and starts; a range that reaches zero is not logarithmic.

    Raises:
        ValueError: for a name that is not free, an empty range, or a start outside its range.
    """
    names = [parameter.name for parameter in free]
    for name in (*ranges, *start):
        if name not in names:
            raise ValueError(f"ranges and starts must be of free parameters, {', '.join(names)}, but got {name}")
    parameters = []
    for parameter in free:
        low, high = ranges.get(parameter.name, (parameter.low, parameter.high))
        at = finite(f"the start of {parameter.name}", start.get(parameter.name, parameter.start))
        if not low < high:
            raise ValueError(
                f"the range of {parameter.name} must be from low to high, but got {low:g} and {high:g}"
            )
        if not low <= at <= high:
            raise ValueError(f"the start of {parameter.name} must be within {low:g} and {high:g}, but got {at:g}")
        is_log = low > 0 and (parameter.log or parameter.name in ranges)
        parameters.append(replace(parameter, low=low, high=high, log=is_log, default=at))
    return tuple(parameters)


def identify(
    logs: Annotated[Any, LogsArgument(metavar="LOG...", type=list[Path], file=READ, last="outliers")],
    free: Annotated[str | Sequence[str], Option(SEARCH, type=str)] = (),
    *,
    ranges: Annotated[
        Mapping[str, tuple[float, float]] | Sequence[str] | None,
        Option(SEARCH, ("--range",), "NAME=LOW:HIGH", list[str]),
    ] = None,
    start: Annotated[
        Mapping[str, float] | Sequence[str] | None, Option(SEARCH, metavar="NAME=VALUE", type=list[str])
    ] = None,
    noise: Annotated[bool, Option(SEARCH, ("--noise/--hold-noise",))] = True,
    use_all: Annotated[bool, Option(LOGS)] = False,
    filter: Annotated[str, FilterOption] = "ekf",
    predicted: Annotated[Sequence[str], Option(FILTER, metavar="CHANNEL")] = (),
    degrees: Annotated[float, Option(SEARCH)] = math.inf,
    gate: Annotated[float, Option(SEARCH)] = math.inf,
    starts: Annotated[int, Option(SEARCH)] = STARTS,
    out: Annotated[str | Path | None, Option(OUTPUT, type=Path, file=WRITTEN, unset=DEFAULT_OUT)] = None,
    plot: WrittenFile = None,
    seed: Seed = 0,
    executor: ExecutorOption = None,
    progress: Progress = None,
) -> Identified:
    """Find the maximum-likelihood parameters for recorded runs, and say which of them the runs determine.

    The free parameters of a thruster may be its constants (motor_damping, voltage_gain, ...), dead_band or
    dead_band_low and dead_band_high, thrust_asymmetry, ambient_velocity, bias_CHANNEL, lag_CHANNEL,
    clock_offset_CHANNEL, and the variances of Q and R; of another model, the arguments with numeric defaults, its
    named constants, and clock_offset_CHANNEL of each measurement and input: an actuator's delay is a negative one.

    With `predicted` the result predicts that channel best for a filter that does not see it: --sensor speed
    --sensor thrust --predicted thrust identifies, on a test stand, a model that estimates thrust on the ship.

    The file that is written is a preset for other commands, for a thruster also for gym.make(preset=...); of
    another model it contains the values. Ctrl-C keeps the best so far.

        found = tuning.identify(("tunnel", ["run1.csv", "run2.csv"]), ["motor_damping", "voltage_gain"])
        found.to_frame()
        found.save("mine.toml")

    Example: thruster identify run*.csv --preset tunnel --free motor_damping,voltage_gain,dead_band

    Example: thruster identify run.csv --model my_module:model --free stiffness,damping --range damping=0:2

    Args:
        logs: recorded run, or several. In Python as `tuning.read_logs` reads them, files or tables of a thruster,
            or a pair (model, logs).
        free: names of the free parameters, separated by commas; a wrong name lists the known ones; of a thruster
            by default its damping, gain and lift. In Python also a list.
        ranges: range of a parameter; may be repeated. In Python (low, high) by name.
        start: where the search begins; may be repeated. In Python values by name.
        noise: whether the variances of Q and R are free, too.
        use_all: hold out no run, and of fewer than three runs not the last quarter of each.
        filter: ekf, or kf for affine models.
        predicted: a channel that the filter predicts but never sees, such as a load cell's thrust.
        degrees: degrees of freedom of Student-t errors, such as 20; of the predicted channels, if any.
        gate: leave out samples beyond so many standard deviations, such as 5, as outliers.
        starts: number of starts of the search.
        out: file for the result, a preset for other commands; out/identified.toml by default. In Python none by
            default.
        plot: profile likelihoods, .png, .svg or .pdf.
        seed: seed of all randomness; the same seed gives the same results.
        executor: where starts run: in N processes, in those of `mpirun`, or on a Dask scheduler's workers; in this
            process by default. In Python also any `concurrent.futures.Executor`.
        progress: whether to show progress; by default only in terminals and notebooks.

    Returns:
        `Identified`: `values`, `standard_errors`, `validation`, `to_frame()`, `save()`, `plot_profiles()`.

    Raises:
        ValueError: states the rule and the value.
        KeyboardInterrupt: after Ctrl-C before there is a best so far.
    """
    if plot is not None:
        check_picture(plot, "--plot")
    if out is not None and not str(out).endswith(".toml"):
        raise ValueError(f"out (--out) must end in .toml, but got {str(out)!r}")
    names, recorded = names_of(free), recorded_runs(logs)
    recorded.check_uncut("an identification")
    runs, proving = split_runs(recorded.files, use_all=use_all, **recorded.splits, **recorded.reading)
    whose = {key: recorded.reading.get(key) for key in ("preset", "model", "sensors")}
    family, console = family_of(runs, names, **whose, noise=noise, filter=filter), console_for(progress)
    begin = {name: finite(f"start (--start) of {name}", value) for name, value in pairs(START, start).items()}
    parameters: tuple[Parameter, ...] = with_ranges(family.free, _ranges(ranges), begin)
    check_offsets(parameters, runs)
    coordinates, unseen = Coordinates(parameters), tuple(predicted)
    objective = likelihood_of(family.data, family.model, coordinates, filter=filter, predicted=unseen)
    check_excitation(objective, runs, coordinates.start())
    with console.status("identifying ...") as status:

        def tell(number: int, value: float, values: dict[str, float]) -> None:
            status.update(f"start {number + 1} of {starts}: log-likelihood {value:.2f}")

        options: dict[str, Any] = {"filter": filter, "predicted": unseen, "starts": starts, "seed": seed}
        options |= {"degrees": degrees, "gate": gate, "progress": tell}
        with task_map(executor) as tasks:
            identification = identify_runs(family.data, family.model, parameters, **options, tasks=tasks)
    checked = validate(identification, family.shifted(proving)) if proving else validate(identification)
    result = Identified(identification, checked, family, tuple(runs), tuple(proving))
    curves: Sequence[Profile] = ()
    if plot is not None and not result.interrupted:
        with console.status("profiles ...") as status:
            curves = profiles(identification, progress=lambda name: status.update(Text(f"profile of {name} ...")))
    if out is not None:
        result.save(out)
    if plot is not None and curves:
        save_figure(profile_figure(identification, curves), Path(plot))
    files = [str(path) for path in (out, plot if curves else None) if path is not None]
    return replace(result, curves=tuple(curves), files=tuple(files))


def _ranges(ranges: Mapping[str, Any] | Sequence[str] | None) -> dict[str, tuple[float, float]]:
    """Ranges by name, also from texts NAME=LOW:HIGH; ValueError for another form."""
    numbers = {}
    for name, ends in pairs(RANGE, ranges).items():
        low, colon, high = ends.partition(":") if isinstance(ends, str) else (ends[0], ":", ends[1])
        if not colon:
            raise ValueError(f"{RANGE} must have the form NAME=LOW:HIGH, but got {short_repr(f'{name}={ends}')}")
        numbers[name] = finite(f"low of {name}", low), finite(f"high of {name}", high)
    return numbers


def names_of(free: Any) -> list[str]:
    """Names of free parameters as a list, also from a text with commas; ValueError for anything else."""
    names = free.split(",") if isinstance(free, str) else list(free) if isinstance(free, list | tuple) else None
    if names is None or not all(isinstance(name, str) for name in names):
        raise ValueError(
            f"free must be names of parameters, but got {short_repr(free)}: a model is given as "
            "read_logs(..., model=...), or with the logs as the pair (model, logs)"
        )
    return [name.strip() for name in names if name.strip()]


def check_excitation(objective: Objective, logs: Sequence[Log], start: np.ndarray) -> None:
    """Raise ValueError for logs with constant inputs that do not determine the free parameters.

    Args:
        objective: log-likelihood of the logs.
        logs: the logs as recorded.
        start: coordinates (p,) of the free parameters.

    Raises:
        ValueError: with the parameters that are not identifiable, by Fisher's information at the start.
    """
    levels = [np.ptp(log.inputs, axis=0) for log in logs]
    if any(level.any() for level in levels):
        return
    coordinates, evaluation = objective.coordinates, objective(start)
    cov = covariance(evaluation.information, evaluation.scores[:0], coordinates.high - coordinates.low)
    narrow = is_narrow(cov, coordinates)
    loose = [name for name, known in zip(coordinates.names, narrow, strict=True) if not known]
    if loose and not levels[0].size:
        raise ValueError(
            f"logs must determine the free parameters, but these do not determine {', '.join(loose)}: leave these "
            "out of free (--free), or record more"
        )
    if loose:
        raise ValueError(
            f"logs must excite the free parameters, but constant inputs do not determine {', '.join(loose)}: "
            "hold these, or record steps"
        )


def check_offsets(parameters: Sequence[Parameter], logs: Sequence[Log]) -> None:
    """Raise ValueError unless ranges of clock offsets are short: without common data any model would fit."""
    most = min(log.times[-1] for log in logs) / OFFSET_SHARE
    for parameter in parameters:
        if parameter.name.startswith(CLOCK) and max(-parameter.low, parameter.high) > most:
            raise ValueError(
                f"the range of {parameter.name} must be within a quarter of the shortest log, {most:g} s, but is "
                f"from {parameter.low:g} to {parameter.high:g}"
            )


def write_found(path: str | Path, result: Identification, family: Any, logs: Sequence[str]) -> None:
    """Write the preset file of a thruster, or the values of a model.

    Args:
        path: path of a file that ends in .toml.
        result: from `tuning.likelihood.identify`.
        family: from `family_of`.
        logs: names of the training runs.

    Raises:
        ValueError: if the path has another ending or cannot be written.
    """
    if not str(path).endswith(".toml"):
        raise ValueError(f"a file of identified parameters must end in .toml, but got {short_repr(str(path))}")
    family = family.plain if isinstance(family, AnyStepFamily) else family
    if isinstance(family, ModelFamily):
        write_values(path, result, logs, getattr(family, "dt", None))  # of a family of logs
    else:
        logs_package().write_identified(path, result, family, logs)
