"""`tuning.read_logs`: recorded runs, how they are read, and how a study cuts them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from filters.named import NamedMaker
from filters.starts import STARTS
from thruster_env.core.checks import one_of, short_repr
from thruster_env.logs.findings import OUTLIERS
from thruster_env.logs.log import Log
from thruster_env.logs.read import INPUTS_ACT
from thruster_env.logs.recorders.bags import STAMPS
from tuning.api.markers import LOGS, READ, Augment, Model, Option, Preset
from tuning.logs.read import check_on_grid, model_of_logs, name_of, read_named, with_numbers
from tuning.series.column import as_columns, is_numbers

if TYPE_CHECKING:
    from tuning.problems.problem import Problem

CUTS = ("blocks", "lead", "start")  # which only a problem of logs has
AUGMENT = "augment"
SPLITS = ("held_out", "hold_gaps", "outliers")


@dataclass(frozen=True, eq=False, repr=False)
class RecordedRuns:
    """Recorded runs with all that one has to know to read them: as `tuning.read_logs` takes it.

    Attributes:
        files: paths, tables or `Log`s.
        reading: options of `tuning.logs.read.read_named`, those that are set.
        splits: held-out runs, whether gaps are held, and whether outliers are left out, if set.
        cuts: how a problem cuts them into blocks, if set.
        augment: constants that the filter also estimates.
    """

    files: Any
    reading: Mapping[str, Any] = field(default_factory=dict)
    splits: Mapping[str, Any] = field(default_factory=dict)
    cuts: Mapping[str, Any] = field(default_factory=dict)
    augment: Any = ()

    def problem(self) -> Problem:
        """The problem of tuning a filter on them."""
        from tuning.logs.problem import log_problem
        from tuning.problems.assumed import augmented, unknowns_of

        problem = log_problem(self.files, **self.reading, **self.splits, **self.cuts)
        return augmented(problem, unknowns_of(self.augment))

    def read(self, *, is_tuned: bool = False) -> tuple[Log, Any]:
        """The only run, and the source of its model at its sample time.

        Args:
            is_tuned: whether a tuned file has the numbers of a model by name.

        Raises:
            ValueError: if there are several runs, or options of such.
        """
        self.check_uncut("one log", (*SPLITS, *CUTS, AUGMENT))
        several = isinstance(self.files, list | tuple)
        if several and len(self.files) != 1:
            raise ValueError(f"logs must be a single one here, but got {len(self.files)}")
        file = self.files[0] if several else self.files
        log, offer = read_named(file, **self.reading, name=name_of(file, 0))
        if not isinstance(offer, NamedMaker):
            return log, offer
        if is_tuned:
            check_on_grid(offer, [log])
            return log, with_numbers(offer, log)[0]
        maker, _, log = with_numbers(offer, log)
        return log, maker if log.stamps is None else maker.continuous(dt=log.dt)

    def check_uncut(self, what: str, options: Sequence[str] = (*CUTS, AUGMENT)) -> None:
        """Raise ValueError if an option is set that only problems of logs have."""
        values = {**self.splits, **self.cuts, **({AUGMENT: self.augment} if self.augment else {})}
        wrong = next((name for name in options if name in values), None)
        if wrong is not None:
            raise ValueError(f"{wrong} must be left out for {what}, but got {short_repr(values[wrong])}")

    def __repr__(self) -> str:
        files = self.files if isinstance(self.files, list | tuple) else [self.files]
        names = ", ".join(name_of(file, number) for number, file in enumerate(files))
        options = {**self.reading, **self.splits, **self.cuts}
        return f"RecordedRuns({', '.join([names, *(f'{key}={short_repr(options[key])}' for key in options)])})"


def read_logs(
    files: Annotated[Any, Option(LOGS, ("--log",), type=list[Path], file=READ)],
    *,
    preset: Preset = None,
    model: Model = None,
    sensors: Annotated[Sequence[str] | None, Option(LOGS, ("--sensor",), choices="sensors")] = None,
    columns: Annotated[
        Mapping[str, str] | Sequence[str] | None, Option(LOGS, ("--column",), "NAME=HEADER[UNIT]", list[str])
    ] = None,
    clock_offset: Annotated[
        Mapping[str, float] | Sequence[str] | None, Option(LOGS, metavar="NAME=SECONDS", type=list[str])
    ] = None,
    dt: Annotated[float | None, Option(LOGS)] = None,
    grid: Annotated[bool, Option(LOGS, ("--grid/--no-grid",))] = True,
    inputs_act: Annotated[str | None, Option(LOGS, choices=INPUTS_ACT)] = None,
    stamps: Annotated[str | None, Option(LOGS, choices=STAMPS)] = None,
    held_out: Annotated[Any, Option(LOGS, type=list[Path], file=READ)] = None,
    hold_gaps: Annotated[bool, Option(LOGS)] = False,
    outliers: Annotated[str | None, Option(LOGS, choices=OUTLIERS)] = None,
    blocks: Annotated[int | None, Option(LOGS)] = None,
    lead: Annotated[int | None, Option(LOGS)] = None,
    start: Annotated[str | None, Option(LOGS, choices=STARTS)] = None,
    augment: Augment = (),
) -> RecordedRuns:
    """Recorded runs, with all that one has to know to read them: for `tune`, `identify`, `estimate`, ...

        runs = tuning.read_logs(["run1.csv", "run2.csv"], columns={"speed": "motor_rpm"}, dt=0.01)
        study = tuning.tune(runs, trials=100)

    Args:
        files: a .csv, .parquet or .npz file with a header, or a recorder's: .ulg, .bin, .bag, .db3, .mcap, .mat,
            .h5. In Python also a pandas.DataFrame, a mapping from headers to arrays, a `Log`, a list of such; or
            numbers (K,) or (K, axes), whose model has a name.
        preset: the thruster of the problem or of the runs.
        model: instead of a thruster, a StateSpaceModel, or a function that returns one (called with dt if it has
            that argument); a name, such as pendulum:length=0.4, constant-velocity:axes=2 or auto, whose numbers
            are found in the log where they are not given; or a FILE.toml with matrices F, H, Q, R, P0. In Python
            also an object that offers one, or a thruster's preset.
        sensors: a thruster's sensor that the filter sees, thrust by default.
        columns: the column of an input, measurement, state or output; may be repeated; of a model of columns of
            numbers HEADER or X,Y. In Python headers by name, such as
            {"speed": "motor_rpm", "thrust": "loadcell[kgf]"}.
        clock_offset: offset of a channel's clock, positive if it is ahead. In Python seconds by name.
        dt: sample time [s] of a log without times, or of the grid for irregular ones; variances are per step.
        grid: whether to put irregular logs on a grid, or to use their own time stamps, for a model in continuous
            time.
        inputs_act: when the input of a row acts: "from" it on, as a command that is sent then, or "until" it, as a
            current that is sampled with a voltage; "between" takes the mean of two rows, as for a rate of the
            instant; "until" by default for models h(x, u, c) and those with rotations, "from" for others.
        stamps: clock of all topics of a bag: header (stamps of their headers) or receipt (when messages were
            received); by default that of the headers if all have one clock.
        held_out: held-out run, never used by a search; by default every third one.
        hold_gaps: hold the last input over gaps of a log; by default runs are split there.
        outliers: samples that `thruster log` calls outliers: kept, or missing, which leaves them out.
        blocks: number of blocks per run; about 72 in total by default.
        lead: number of rows at the beginning of a block that are not scored; 50 by default.
        start: initial state of blocks: prior, or measurement, from their first measurement, the default of
            ekf-robust.
        augment: let the filter also estimate this constant of its model, such as voltage_gain, with prior
            deviation STD; its random walk, at first WALK per step, is tuned with Q; may be repeated. In Python an
            `Unknown` or (std, walk) by name.

    Returns:
        `RecordedRuns`, which are read when they are used.

    Raises:
        ValueError: states the rule and the value.
    """
    files, model, preset = model_of_logs(files, model, preset)
    files = as_columns(files) if is_numbers(files) else files
    for name, value, choices in (("outliers", outliers, OUTLIERS), ("start", start, STARTS)):
        if value is not None:
            one_of(name, value, choices)
    reading = {"preset": preset, "model": model, "sensors": sensors, "columns": columns}
    reading |= {"clock_offset": clock_offset, "dt": dt, "grid": None if grid else False}
    reading |= {"inputs_act": inputs_act, "stamps": stamps}
    splits = {"held_out": held_out, "hold_gaps": hold_gaps or None, "outliers": outliers}
    cuts = {"blocks": blocks, "lead": lead, "start": start}
    reading, splits, cuts = ({k: part[k] for k in part if part[k] is not None} for part in (reading, splits, cuts))
    return RecordedRuns(files, reading, splits, cuts, augment)


def recorded_runs(logs: Any) -> RecordedRuns:
    """Runs as `read_logs` makes them, from these, from a pair (model, logs) or from logs of a thruster."""
    return logs if isinstance(logs, RecordedRuns) else read_logs(logs)
