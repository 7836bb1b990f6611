"""`tuning.identify`: a thruster's parameters, or any model's, from recorded runs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from thruster_env.core.checks import short_repr
from thruster_env.logs.log import Log
from thruster_env.model.state_space import StateSpaceModel
from tuning.api.display import drawn, frame, html
from tuning.api.progress import console_for
from tuning.identification.family import with_ranges
from tuning.identification.identify import STARTS, check_excitation
from tuning.identification.identify import identify as identify_runs
from tuning.identification.objective import Objective
from tuning.identification.profiles import Validation, fall_sentence, profile_figure, profiles, validate
from tuning.identification.result import Identification
from tuning.logs.problem import AnyStepFamily, check_offsets, family_of, remarks, split_runs, write_found
from tuning.logs.read import model_of_logs
from tuning.problems.problem import Coordinates, Parameter

# `Identified`: parameters identified from recorded runs, as a value.


if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class Identified:
    """Maximum-likelihood values of free parameters, their uncertainty, and the model's errors on other runs.

    Attributes:
        found: the identification itself.
        validation: of the model at the "start" and "identified", on the held-out runs, or else on the same runs.
        family: the thruster or the model whose parameters are free.
        runs: runs used for identification.
        held_out: runs used only for validation.
    """

    found: Identification
    validation: Mapping[str, Validation]
    family: Any
    runs: tuple[Log, ...]
    held_out: tuple[Log, ...] = ()

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

    def __repr__(self) -> str:
        values = ", ".join(f"{name} {value:.4g}" for name, value in list(self.values.items())[:6])
        more = ", ..." if len(self.values) > 6 else ""
        loose = sum(not known for known in self.determined.values())
        verdict = f"{loose} of {len(self.values)} not determined" if loose else "all determined"
        return f"Identified({values}{more}; {verdict}, {len(self.runs)} runs)"

    def _repr_html_(self) -> str:
        tests = self.found.null_tests
        units = {parameter.name: parameter.unit for parameter in self.found.objective.coordinates.free}
        rows = [
            [name, units[name], f"{self.found.start[name]:.5g}", f"{value:.5g}"]
            + [f"{self.standard_errors[name]:.2g}", "yes" if self.determined[name] else "no"]
            + ([f"{tests[name].at:.4g}", tests[name].said] if name in tests else ["-", "-"])
            for name, value in self.values.items()
        ]
        columns = ["", "unit", "start", "value", "standard error", "determined", "if left out, at", "p"]
        steps = sum(log.steps for log in self.runs)
        title = f"Identified on {len(self.runs)} runs, {steps} steps"
        return html(title, columns, rows, " ".join(self.sentences()))


def identify(
    logs: Any,
    free: str | Sequence[str] = (),
    *,
    model: Any = None,
    preset: str | Path | None = None,
    sensors: Sequence[str] | None = None,
    columns: Any = None,
    clock_offset: Any = None,
    dt: float | None = None,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    start: Mapping[str, float] | None = None,
    noise: bool = True,
    held_out: Any = None,
    use_all: bool = False,
    hold_gaps: bool = False,
    grid: bool = True,
    stamps: str | None = None,
    filter: str = "ekf",
    predicted: Sequence[str] = (),
    degrees: float = math.inf,
    gate: float = math.inf,
    starts: int = STARTS,
    seed: int = 0,
    progress: bool | None = None,
) -> Identified:
    """Find the maximum-likelihood parameters for recorded runs, and say which of them the runs determine.

    A thruster's free parameters may be its constants (motor_damping, voltage_gain, ...), dead_band,
    thrust_asymmetry, ambient_velocity, bias_CHANNEL, lag_CHANNEL, clock_offset_CHANNEL, and the variances of Q and
    R; another model's may be its arguments with numeric defaults and its named constants. Ctrl-C keeps the best so
    far.

        found = tuning.identify(["run1.csv", "run2.csv"], ["motor_damping", "voltage_gain"], preset="tunnel")
        found.to_frame()
        found.save("mine.toml")

    Args:
        logs: one recorded run or several: paths of .csv, .parquet or .npz files, or of recorders', tables, or
            `Log`s; or a pair (model, logs).
        free: names of the free parameters; for a thruster its damping, gain and lift by default.
        model: instead of a thruster: a function that returns a `StateSpaceModel` (called with dt if it has that
            argument), a model, "module:object" for either, or a thruster's preset.
        preset: the thruster where the search starts, by name or file.
        sensors: a thruster's channels that the filter sees.
        columns: headers by quantity.
        clock_offset: seconds by quantity that a channel's clock is ahead.
        dt: sample time [s] of logs without times, or of the grid.
        ranges: search ranges (low, high) by name.
        start: values by name where the search begins.
        noise: whether the variances of Q and R are also free.
        held_out: runs used only for validation, as objects or paths; by default every third of three or more.
        use_all: hold no run out.
        hold_gaps: hold the last input over gaps of a log; by default runs are split there.
        stamps: of bags, "header" or "receipt", as in `estimate`.
        grid: whether logs are put on one; else on their own stamps, for a model whose sample time is a constant:
            Q of a step is then in proportion to its length, and the values are those of `dt`.
        filter: "ekf", or "kf" for affine models.
        predicted: channels that the filter predicts but never sees, such as a load cell's thrust.
        degrees: of freedom of Student-t errors, such as 20, of predicted channels, if there are any.
        gate: leave out samples beyond so many standard deviations, such as 5, as outliers.
        starts: number of starts of the search.
        seed: of the random starts.
        progress: whether to show progress; by default only in terminals and notebooks.

    Returns:
        `Identified`: `values`, `standard_errors`, `validation`, `to_frame()`, `save()`, `plot_profiles()`.

    Raises:
        ValueError: states the rule and the value.
        KeyboardInterrupt: after Ctrl-C before there is a best so far.
    """
    names = names_of(free)
    logs, model, preset = model_of_logs(logs, model, preset)
    whose: dict[str, Any] = {"preset": preset, "model": model, "sensors": sensors}
    read: dict[str, Any] = {**whose, "columns": columns, "clock_offset": clock_offset, "dt": dt, "grid": grid}
    read["stamps"] = stamps
    runs, proving = split_runs(logs, held_out, use_all=use_all, hold_gaps=hold_gaps, **read)
    family = family_of(runs, names, **whose, noise=noise, filter=filter)
    search: dict[str, Any] = {"predicted": tuple(predicted), "degrees": degrees, "gate": gate, "starts": starts}
    return identified(
        family, runs, proving, ranges, start, console_for(progress), filter=filter, seed=seed, **search
    )


def names_of(free: Any) -> list[str]:
    """Names of free parameters as a list; ValueError for anything but one name or some."""
    names = [free] if isinstance(free, str) else list(free) if isinstance(free, list | tuple) else None
    if names is None or not all(isinstance(name, str) for name in names):
        raise ValueError(
            f"free must be names of parameters, "
            f"but got {short_repr(free)}: a model is given as model=..., or with the "
            "logs as the pair (model, logs)"
        )
    return names


def identified(
    family: Any,
    runs: Sequence[Log],
    proving: Sequence[Log],
    ranges: Mapping[str, tuple[float, float]] | None,
    start: Mapping[str, float] | None,
    console: Console,
    *,
    filter: str,
    predicted: Sequence[str] = (),
    starts: int = STARTS,
    **search: Any,
) -> Identified:
    """Check the request, search with progress, and validate, as `thruster identify` does.

    Args:
        family: from `tuning.logs.problem.family_of`.
        runs: for identification.
        proving: for validation; if there are none, `runs` are used.
        ranges: of some free parameters.
        start: of some.
        console: where progress is shown.
        filter: whose innovations count.
        predicted: channels that it never sees.
        starts: how many.
        **search: further options of `tuning.identification.identify.identify`.
    """
    parameters: tuple[Parameter, ...] = with_ranges(family.free, ranges or {}, start or {})
    check_offsets(parameters, runs)
    coordinates = Coordinates(parameters)
    objective = Objective(family.data, family.model, coordinates, filter=filter, predicted=predicted)
    check_excitation(objective, runs, coordinates.start())
    with console.status("identifying ...") as status:

        def tell(number: int, value: float, values: dict[str, float]) -> None:
            status.update(f"start {number + 1} of {starts}: log-likelihood {value:.2f}")

        options: dict[str, Any] = {"filter": filter, "predicted": predicted, "starts": starts, **search}
        identification = identify_runs(family.data, family.model, parameters, **options, progress=tell)
    checked = validate(identification, family.shifted(proving)) if proving else validate(identification)
    return Identified(identification, checked, family, tuple(runs), tuple(proving))
