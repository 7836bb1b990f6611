"""Model structures identified from the recordings, and their errors of thrust against the load cell.

In order: the structures; their identification; errors and ratios to the recorder's own estimate; other estimators;
a larger process noise after reversals; and the tables of docs/real_data.md and of `thruster reproduce recordings`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from filters.engine.batch import run as run_filter
from filters.gaussian.extended import ExtendedKalmanFilter
from thruster_env.core.files import as_toml, check_target, write_whole
from thruster_env.core.text_tables import Table, markdown_table
from thruster_env.model.state_space import StateSpaceModel
from tuning.api.markers import INPUT, OUTPUT, RUNS, Option
from tuning.api.result import Printed
from tuning.cli.output import progress_of
from tuning.experiments.recordings_model import (
    DT,
    IDENTIFIED,
    LOAD_CELL,
    Recording,
    model,
    on_line,
    read_recordings,
    to_identify,
)
from tuning.likelihood.identify import identify
from tuning.likelihood.recorded import runs_of
from tuning.likelihood.result import Identification, valued
from tuning.problems.check import digest_of
from tuning.problems.problem import Parameter

DEGREES = 20.0  # degrees of freedom of the load cell's errors: it rings after each start and reversal
CHOSEN = "flow and inertia"
NONE_HELD_OUT = ""

# Of errors against the load cell.
WINDOW = 5  # rows, 0.2 s, over which estimate and load cell are averaged: the mount swings at 14 Hz
SHIFTS = np.arange(-0.12, 0.1201, 0.01)  # of the clock [s]; each estimate may have its best one
SETTLED = 1.2  # after the start, and after every change of the command's sign [s]

# Of the estimators.
OURS, OWN, DESIRED, STATIC_MAP, LOOKUP = "ours", "recorder's", "desired", "static map", "lookup"
# Least squares on the table of steady states of the same source, ahead and astern.
STATIC_FACTORS = 0.968e-3, 0.979e-3  # T = c n|n| [N s^2]
LOOKUP_FACTORS, LOOKUP_BAND = (2.51, 2.62), 0.84  # T = k (|u| - 0.84)^2 [N/V^2, V]

# Of the noise after reversals.
AFTER = 0.4  # s after the start and after each reversal
FACTORS = (1.0, 4.0, 16.0, 64.0, 256.0)  # on Q in that time

# Of the tables.
RESULTS = Path("out") / "recordings.json"
MEAN = "mean"
RATIO_HEADER = ["run", "own, N", "ours, N", "ratio", "best clocks", "raw rows"]
CLOCK_HEADER = ["run", "offset, s", "first half", "second half"]
LADDER_HEADER = ["model", "ratio, worst", "ratio, mean", "raw rows, worst", "log-likelihood"]
NUMBER_HEADER = ["constant", "value", "standard error", "without one run", "unit"]
Estimates = Mapping[str, Sequence[np.ndarray]]


def _positive(name: str, low: float, high: float, unit: str = "", default: float | None = None) -> Parameter:
    return Parameter(name, low, high, unit, default=default)


def _any(name: str, low: float, high: float, unit: str = "", default: float | None = None) -> Parameter:
    return Parameter(name, low, high, unit, log=False, default=default)


MOTOR = (
    _positive("motor_rate", 8.0, 200.0, "1/s", 60.0),
    _any("motor_gain", 40.0, 65.0, "rad/(s V)", 51.0),
)
BAND = (_any("dead_band_low", -1.2, -0.3, "V", -0.8), _any("dead_band_high", 0.3, 1.2, "V", 0.8))
LAG = (_positive("tachometer_lag", 8e-3, 0.12, "s", 0.04),)
# Thrust over squared speed is 0.7 to 1.2 times 1e-3 within one ramp, and greatest before the water moves.
BLADES = (_positive("thrust_factor", 8e-4, 2e-3, "N s^2", 1.5e-3),)
SIDES = (_any("gain_ratio", 0.8, 1.25, default=1.0), _any("thrust_ratio", 0.8, 1.3, default=1.05))
FLOW = (
    _positive("flow_factor", 0.01, 3.0, "N s^2/m", 0.4),
    _positive("flow_linear", 0.02, 30.0, "1/s", 1.0),
    _positive("flow_quadratic", 0.02, 200.0, "1/m", 20.0),
)
INERTIA = (_any("inertia", -0.02, 0.15, "N s^2", 5e-3),)
AMBIENT = (_any("ambient_factor", -3.0, 3.0, default=0.1),)
MOUNT = (
    _any("mount_share", 0.0, 1.5, default=0.4),
    _any("mount_frequency", 11.0, 16.0, "Hz", 14.0),
    _positive("mount_damping", 0.02, 0.4, default=0.1),
)
NOISE = (
    _positive("Q11", 0.25, 400.0, "(rad/s)^2", 9.0),
    _positive("Q22", 0.01, 40.0, "(rad/s)^2", 1.0),
    _positive("R11", 0.1, 40.0, "(rad/s)^2", 3.0),
    _positive("R22", 0.04, 25.0, "N^2", 1.0),
)


class Structure(NamedTuple):
    """Effects in the model, and the free parameters."""

    about: str
    free: tuple[Parameter, ...]
    fixed: Mapping[str, float] = {}
    ambient: bool = False  # whether the measured ambient flow is an input

    def model(self, **values: float) -> StateSpaceModel:
        """The model with the load cell for values of the free parameters."""
        mount = MOUNT[0] in self.free
        return valued(to_identify(self.ambient, mount), {**self.fixed, **values})


STATIC = (*MOTOR, *BAND, *LAG, *BLADES, *SIDES, *NOISE)
WHOLE = (*STATIC, *FLOW, *INERTIA)


def _without(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    return tuple(parameter for parameter in WHOLE if parameter not in parameters)


STRUCTURES = {
    "static": Structure("thrust by motor speed alone", STATIC, {"flow_factor": 0.0}),
    "flow": Structure("with axial flow", (*STATIC, *FLOW)),
    CHOSEN: Structure("with axial flow and inertial force: the chosen one", WHOLE),
    "ambient": Structure("... and the measured ambient flow", (*WHOLE, *AMBIENT), ambient=True),
    "mount": Structure("... and the mount's swinging", (*WHOLE, *MOUNT)),
    "no flow": Structure("the chosen one, without axial flow", _without(FLOW), {"flow_factor": 0.0}),
    "no dead band": Structure(
        "... without the dead band", _without(BAND), {"dead_band_low": 0.0, "dead_band_high": 0.0}
    ),
    "no lag": Structure("... with a tachometer's lag of 8 ms", _without(LAG), {"tachometer_lag": 8e-3}),
    "symmetric": Structure(
        "... the same ahead and astern", _without(SIDES), {"gain_ratio": 1.0, "thrust_ratio": 1.0}
    ),
}


def identified(
    structure: Structure, runs: Sequence[Recording], starts: int = 1, progress: Callable | None = None
) -> Identification:
    """The parameters of a structure with the best prediction of tachometer and load cell.

    The filter uses the tachometer only; the load cell's channel is predicted (`identify`).
    """
    return identify(
        [recording.log(structure.ambient) for recording in runs],
        structure.model,
        structure.free,
        predicted=[LOAD_CELL.symbol],
        degrees=DEGREES,
        starts=starts,
        simulation_first=False,  # a simulation would have the wrong sign of the speed for a while
        progress=progress,
    )


def thrusts(model: StateSpaceModel, runs: Sequence[Recording], ambient: bool = False) -> list[np.ndarray]:
    """Estimated thrust (K + 1,) on each run, of an EKF with command and tachometer, on the recorder's clock.

    Args:
        model: identified, with or without the load cell.
        runs: recorded.
        ambient: whether the measured ambient flow is an input.
    """
    data = runs_of([recording.log(ambient) for recording in runs])
    on_line_model = on_line(model)
    estimates = run_filter(
        ExtendedKalmanFilter(model=on_line_model), data.filter_keys, data.inputs, data.measurements[..., :1].copy()
    )
    thrust = on_line_model.output("T", estimates.means)
    return [thrust[i, : len(recording.times)] for i, recording in enumerate(runs)]


class Task(NamedTuple):
    """One identification."""

    structure: str
    held_out: str = NONE_HELD_OUT  # the held-out run

    @property
    def name(self) -> str:
        """Its name in messages and files."""
        return f"{self.structure}, without {self.held_out}" if self.held_out else self.structure


def tasks_of(runs: Sequence[Recording]) -> list[Task]:
    """The chosen structure, with all runs and without each one; then the other structures in the same way."""
    names = [NONE_HELD_OUT, *(run.name for run in runs)]
    order = [CHOSEN, *(name for name in STRUCTURES if name != CHOSEN)]
    return [Task(structure, held_out) for structure in order for held_out in names]


def identify_all(
    runs: Sequence[Recording], file: Path, starts: int = 4, progress: Callable[[str, int, int], None] | None = None
) -> dict[str, dict[str, Any]]:
    """Values, standard errors and log-likelihoods of every task, by its name; tasks in the file are not repeated.

    Args:
        runs: the recordings.
        file: JSON, written after every task; a file of other runs or structures is replaced.
        starts: number of starts of the identification with all runs; the others have one start, at round numbers.
        progress: called with a task's name, the number of finished tasks, and the number of all tasks.
    """
    digest = digest_of(
        tuple(run.log(True).digest for run in runs), [(*structure,) for structure in STRUCTURES.values()], starts
    )
    stored = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    results = stored["tasks"] if stored.get("digest") == digest else {}
    tasks = tasks_of(runs)
    for number, task in enumerate(tasks):
        if progress is not None:
            progress(task.name, number, len(tasks))
        if task.name in results:
            continue
        learning = [recording for recording in runs if recording.name != task.held_out]
        first = task == Task(CHOSEN)
        learnt = identified(STRUCTURES[task.structure], learning, starts if first else 1)
        if learnt.interrupted:
            raise KeyboardInterrupt
        results[task.name] = {
            "values": learnt.values,
            "standard_errors": learnt.standard_errors,
            "determined": learnt.determined,
            "log_likelihood": learnt.log_likelihood,
            "agreement": [learnt.agreement, len(learnt.optima)],
            "sentences": learnt.sentences(),
        }
        write_whole(file, json.dumps({"digest": digest, "tasks": results}, indent=1))
    return results


class Ratios(NamedTuple):
    """RMSE of an estimate over that of the recorder's own, on one run."""

    averaged: float  # over windows, at the run's clock offset
    best_shift: float  # the same, where each has its own best offset
    raw: float  # of single rows


def averaged(values: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """Centred means over `window` rows, fewer at the ends."""
    ones = np.ones(window)
    return np.convolve(values, ones, "same") / np.convolve(np.ones(len(values)), ones, "same")


def error(estimate: np.ndarray, run: Recording, offset: float, window: int = WINDOW) -> np.ndarray:
    """Estimate minus load cell [N], on the rows of the load cell.

    Args:
        estimate: (K + 1,), on the recorder's clock.
        run: with the load cell.
        offset: how far the load cell's clock is ahead [s].
        window: rows to average over.
    """
    shifted = np.interp(run.times - offset, run.times, estimate)
    return averaged(shifted, window) - averaged(run.load, window)


def rmse(estimate: np.ndarray, run: Recording, offset: float | None = None, window: int = WINDOW) -> float:
    """Root mean square of `error`, at the run's clock offset unless another one is given."""
    errors = error(estimate, run, run.offset if offset is None else offset, window)
    return float(np.sqrt((errors**2).mean()))


def settled_rmse(estimate: np.ndarray, run: Recording, window: int = WINDOW) -> float:
    """`rmse` over the rows later than 1.2 s after the start and after every change of the command's sign."""
    signs = np.sign(run.command)
    changes = [run.times[0], *run.times[1:][(signs[1:] != signs[:-1]) & (signs[1:] != 0)]]
    quiet = np.all([(run.times < when) | (run.times > when + SETTLED) for when in changes], axis=0)
    return float(np.sqrt((error(estimate, run, run.offset, window)[quiet] ** 2).mean()))


def best_rmse(estimate: np.ndarray, run: Recording) -> float:
    """`rmse` at the clock offset at which it is least."""
    return min(rmse(estimate, run, shift) for shift in SHIFTS)


def ratios(estimate: np.ndarray, run: Recording) -> Ratios:
    """An estimate's errors over those of the recorder's own."""
    return Ratios(
        rmse(estimate, run) / rmse(run.own, run),
        best_rmse(estimate, run) / best_rmse(run.own, run),
        rmse(estimate, run, window=1) / rmse(run.own, run, window=1),
    )


def estimates_of(runs: Sequence[Recording], held_out: Mapping[str, Mapping] | None = None) -> dict[str, list]:
    """Thrust (K + 1,) on each run by every estimator, by name.

    Args:
        runs: recorded.
        held_out: tasks by name (`identify_all`): our estimate of a run then has the parameters that were
            identified without this run. If None those of `identified.toml`.
    """
    ours = thrusts(model(), runs) if held_out is None else left_out(CHOSEN, runs, held_out)
    return {
        OURS: ours,
        OWN: [run.own for run in runs],
        DESIRED: [run.desired for run in runs],
        STATIC_MAP: [_static(run) for run in runs],
        LOOKUP: [_lookup(run) for run in runs],
    }


def left_out(structure: str, runs: Sequence[Recording], tasks: Mapping[str, Mapping]) -> list[np.ndarray]:
    """Thrust on each run by a structure that was identified without that run."""
    chosen, estimates = STRUCTURES[structure], []
    for run in runs:
        values = tasks[Task(structure, run.name).name]["values"]
        estimates += thrusts(chosen.model(**values), [run], chosen.ambient)
    return estimates


def structure_ratios(structure: str, runs: Sequence[Recording], tasks: Mapping[str, Mapping]) -> list[Ratios]:
    """Ratios to the recorder's own estimate on each run, left out of the identification."""
    return [ratios(estimate, run) for estimate, run in zip(left_out(structure, runs, tasks), runs, strict=True)]


def _static(run: Recording) -> np.ndarray:
    """From the tachometer with the sign of the previous command."""
    sign = np.sign(np.append(0.0, run.command[:-1]))
    speed = sign * np.nan_to_num(run.tachometer)
    return np.where(speed > 0, *STATIC_FACTORS) * speed * abs(speed)


def _lookup(run: Recording) -> np.ndarray:
    """From the previous command."""
    command = np.append(0.0, run.command[:-1])
    beyond = np.maximum(abs(command) - LOOKUP_BAND, 0.0)
    return np.sign(command) * np.where(command > 0, *LOOKUP_FACTORS) * beyond**2


class Regime(NamedTuple):
    """Results with a factor on Q after reversals."""

    factor: float
    log_likelihood: float  # of the tachometer, all runs
    nis: float  # mean over all steps; expected value 1
    ratio: float  # mean over the runs of the thrust's error over that of the recorder's own


def regimes(model: StateSpaceModel, runs: Sequence[Recording], factors: Sequence[float] = FACTORS) -> list[Regime]:
    """The extended Kalman filter with each factor on Q after reversals."""
    tachometer_model, results = on_line(model), []
    for factor in factors:
        parts = [_filtered(tachometer_model, run, factor) for run in runs]
        squares = np.concatenate([part[1] for part in parts])
        values = [ratios(part[0], run).averaged for part, run in zip(parts, runs, strict=True)]
        likelihood = sum(part[2] for part in parts)
        results.append(Regime(factor, likelihood, float(squares.mean()), float(np.mean(values))))
    return results


def after_reversal(command: np.ndarray) -> np.ndarray:
    """Whether each step lies within 0.4 s of the start, or of a change of the command's sign."""
    signs = np.sign(command)
    changed = np.append(True, (signs[1:] != signs[:-1]) & (signs[1:] != 0))
    return np.convolve(changed, np.ones(round(AFTER / DT)))[: len(command)] > 0


def _filtered(model: StateSpaceModel, run: Recording, factor: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Thrust (K + 1,), NIS of the steps that were measured, and their log-likelihood."""
    factors = np.where(after_reversal(run.command)[:-1], factor, 1.0)
    estimates = run_filter(
        ExtendedKalmanFilter(model=model),
        inputs=run.command[None, :-1, None],
        measurements=run.tachometer[None, :, None],
        process_noise_covs=factors[:, None, None] * model.process_noise_cov,
    )
    thrust = [model.outputs["T"].function(tuple(mean), model.constants) for mean in estimates.means[0]]
    measured = ~np.isnan(run.tachometer)
    squares = estimates.innovations[0, measured, 0] ** 2 / estimates.innovation_covs[0, measured, 0, 0]
    return np.array(thrust), squares, float(estimates.log_likelihoods.sum())


def tables_of(
    runs: Sequence[Recording], estimates: Estimates, tasks: Mapping[str, Mapping] | None = None
) -> dict[str, Table]:
    """All tables by name, in their order; those of structures and parameters where these were identified again."""
    which = "the project's parameters" if tasks is None else "parameters identified without the run"
    title, errors = f"RMSE of thrust over 0.2 s; {which}", "RMSE over 0.2 s, N: all rows / settled"
    tables = {
        "ratios": Table(title, RATIO_HEADER, ratio_rows(runs, estimates)),
        "estimators": Table(errors, ["run", *estimates], baseline_rows(runs, estimates)),
        "clocks": Table("how far the load cell's clock is ahead", CLOCK_HEADER, clock_rows(runs)),
    }
    if tasks is not None:
        tables["structures"] = Table("the contribution of each effect", LADDER_HEADER, ladder_rows(runs, tasks))
        tables["numbers"] = Table("numbers found", NUMBER_HEADER, number_rows(runs, tasks))
    return tables


def ratio_rows(runs: Sequence[Recording], estimates: Estimates) -> list[list[str]]:
    """Our error over that of the recorder's own, on each run and on average."""
    all_ratios = [ratios(estimate, run) for estimate, run in zip(estimates[OURS], runs, strict=True)]
    rows = []
    for run, of_run, ours in zip(runs, all_ratios, estimates[OURS], strict=True):
        mark = " (desired)" if run.own_is_desired else ""
        own_rmse = f"{rmse(run.own, run):.2f}{mark}"
        rows.append([run.name, own_rmse, f"{rmse(ours, run):.2f}", *(f"{value:.2f}" for value in of_run)])
    return [*rows, [MEAN, "", "", *(f"{value:.2f}" for value in np.mean(all_ratios, axis=0))]]


def baseline_rows(runs: Sequence[Recording], estimates: Estimates) -> list[list[str]]:
    """RMSE of every estimator over 0.2 s on each run: all rows, then settled ones [N]."""
    rows = []
    for i, run in enumerate(runs):
        cells = [
            f"{rmse(estimate[i], run):.2f}/{settled_rmse(estimate[i], run):.2f}" for estimate in estimates.values()
        ]
        rows.append([run.name, *cells])
    return rows


def clock_rows(runs: Sequence[Recording]) -> list[list[str]]:
    """The offset of the load cell's clock on each run."""
    return [[run.name, *(f"{value + 0.0:+.3f}" for value in (run.offset, *run.halves))] for run in runs]


def ladder_rows(runs: Sequence[Recording], tasks: Mapping[str, Mapping]) -> list[list[str]]:
    """The errors of each structure, on runs left out of the identification."""
    rows = []
    for name, structure in STRUCTURES.items():
        errors = np.array(structure_ratios(name, runs, tasks))
        cells = errors[:, 0].max(), errors[:, 0].mean(), errors[:, 2].max()
        likelihood = tasks[Task(name).name]["log_likelihood"]
        rows.append([structure.about, *(f"{value:.2f}" for value in cells), f"{likelihood:.0f}"])
    return rows


def number_rows(runs: Sequence[Recording], tasks: Mapping[str, Mapping]) -> list[list[str]]:
    """The chosen parameters, their standard errors, and their range when one run is left out."""
    with_all, rows = tasks[Task(CHOSEN).name], []
    for parameter in STRUCTURES[CHOSEN].free:
        value, error = with_all["values"][parameter.name], with_all["standard_errors"][parameter.name]
        left_out = [tasks[Task(CHOSEN, run.name).name]["values"][parameter.name] for run in runs]
        name = parameter.name if with_all["determined"][parameter.name] else f"{parameter.name} (not determined)"
        rows.append(
            [name, f"{value:.4g}", f"{error:.2g}", f"{min(left_out):.4g} to {max(left_out):.4g}", parameter.unit]
        )
    return rows


def sentences(estimates: Estimates, runs: Sequence[Recording]) -> list[str]:
    """The table of ratios in one sentence."""
    all_ratios = np.array([ratios(estimate, run) for estimate, run in zip(estimates[OURS], runs, strict=True)])
    averaged, best, raw = all_ratios.T
    return [
        f"Averaged over 0.2 s the error of the estimated thrust is on average {averaged.mean():.2f} times that of "
        f"the recorder's own, at most {averaged.max():.2f}; with the best clocks at most {best.max():.2f}; "
        f"on raw rows {raw.min():.2f} to {raw.max():.2f}."
    ]


def reproduce(
    data: Annotated[Path, Option(INPUT)],
    identify: Annotated[bool, Option(RUNS)] = False,
    out: Annotated[Path, Option(OUTPUT)] = RESULTS,
) -> Printed:
    """Compare estimates of a recorded thruster's thrust with its load cell, and with the recorder's own estimate.

    The filter sees command and tachometer. By default its parameters are the project's, identified from six runs;
    with --identify, each run is estimated with parameters identified without that run. The recordings are those of
    J. A. Boehm (University of Maryland, 2019), which are not part of this project: see docs/real_data.md.

    Example: thruster reproduce recordings --data rov_thruster

    Args:
        data: folder with the recorded runs as .csv files, or with a folder closed_loop_25Hz.
        identify: identify all parameters again, of nine structures, with and without each run: a quarter of an
            hour.
        out: with --identify: file of results; existing ones are not recomputed.
    """
    runs, tasks = read_recordings(data), None
    if identify:
        check_target(out)
        with progress_of("identifying", out) as progress:
            tasks = identify_all(runs, out, progress=progress)
    estimates = estimates_of(runs, tasks)
    tables = tables_of(runs, estimates, tasks)
    named = {
        name: [dict(zip(content.columns, row, strict=True)) for row in content.rows]
        for name, content in tables.items()
    }
    answers = sentences(estimates, runs)
    return Printed([*tables.values(), *answers], {**named, "answers": answers})


def tables_from(recordings: Path, results: Path = RESULTS) -> dict[str, Callable[[], str]]:
    """The tables of docs/real_data.md by name, from a folder of recordings; the project's numbers are written.

    Identifications that are in the file of results are not done again; all take a quarter of an hour on two cores.
    """
    runs = read_recordings(recordings)
    tasks = identify_all(runs, results, progress=lambda name, done, count: print(f"{done + 1}/{count} {name}"))
    keep(tasks[Task(CHOSEN).name], [run.name for run in runs])
    left_out = estimates_of(runs, tasks)

    def regime() -> str:
        rows = [
            [f"{row.factor:g}", f"{row.log_likelihood:.0f}", f"{row.nis:.2f}", f"{row.ratio:.3f}"]
            for row in regimes(model(), runs)
        ]
        return markdown_table(["Q times", "log-likelihood of the tachometer", "mean NIS", "ratio, mean"], rows)

    tables = tables_of(runs, left_out, tasks)
    return {
        **{name: table.on_page for name, table in tables.items()},
        "ratios": lambda: "\n\n".join([tables["ratios"].on_page(), *sentences(left_out, runs)]),
        "regime": regime,
    }


def keep(task: Mapping, runs: Sequence[str]) -> None:
    """Write the numbers that the project takes."""
    known = {name: task[name] for name in ("log_likelihood", "standard_errors", "determined")}
    tables = {"values": task["values"], "identified": {"logs": list(runs), **known}}
    write_whole(IDENTIFIED, as_toml(tables, "Found by `python -m docs.scripts real_data`; see docs/real_data.md."))
