"""The model `attitude` on BROAD: errors of an extended Kalman filter against motion capture, on whole trials.

    thruster reproduce broad --data broad        # a clone of github.com/dlaidig/broad, or its folder data_mat

A trial is three minutes of gyroscope, accelerometer and magnetometer at 286 Hz, with a reference in east, north,
up. Errors are BROAD's: of the error quaternion e = q q_ref^-1 in the world, with e = (w, x, y, z),

    total = 2 acos|w|,   heading = 2 atan|z/w|,   inclination = 2 acos sqrt(w^2 + z^2)

as root mean squares over the rows in motion that have a reference, in degrees. The numbers of the model are those
of maximum likelihood on the first 30 s of motion of the training trials, without their reference. The gyroscope's
two are given: the model's own, and the one of a grid that has the least error on the training trials, which takes
their reference. The recordings are not part of this project.

Source: D. Laidig, M. Caruso, A. Cereatti, T. Seel (2021), "BROAD - A Benchmark for Robust Inertial Orientation
Estimation", Data 6(7):72, doi 10.3390/data6070072; data CC BY 4.0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

import filters
from filters.inertial import FREE, attitude
from filters.starts import begun_at
from thruster_env.core.text_tables import Table
from thruster_env.logs.recorders.arrays import arrays_of
from thruster_env.model import rotations
from tuning.api.identify import identify as maximum_likelihood
from tuning.api.markers import INPUT, RUNS, Option
from tuning.api.result import Printed
from tuning.cli.output import progress_of

TRAINING, HELD_OUT, DISTURBED = ("02", "07", "11", "16"), ("03", "06", "12", "15", "21"), ("31",)
ARRAYS = {"imu_gyr": 3, "imu_acc": 3, "imu_mag": 3, "opt_quat": 4}  # columns of a trial's arrays
BEFORE, SECONDS = 1.5, 30.0  # of rest and of motion that are identified [s]
NUMBERS = {  # of `identified`
    "accelerometer": 0.0049,
    "magnetometer": 1.95,
    "acceleration": 6.64,
    "frequency": 1.845,
    "damping": 0.0348,
    "field": 44.73,
    "dip": 68.9,
    "gravity": 9.815,
}
GYROSCOPE = 2e-4  # of `attitude` [rad/s/sqrt(Hz)]
GYROSCOPES = (1e-4, GYROSCOPE, 4e-4, 8e-4, 1.6e-3)
# Other filters from the attitude of the first 1.5 s, gains by a grid on the training trials' reference, VQF 2.1.2
# with its defaults, in November 2026: total, inclination and heading.
OTHERS = {
    "Madgwick, gain 0.12": ((3.63, 2.38, 2.64), (5.02, 2.97, 3.98), (4.50, 3.10, 3.26)),
    "Mahony, gain 1": ((7.76, 3.99, 6.63), (7.01, 4.07, 5.60), (10.5, 6.52, 8.24)),
    "VQF": ((1.20, 0.60, 1.01), (2.74, 0.73, 2.63), (3.21, 1.14, 3.00)),
}
HEADER = ("filter", "training", "held out", "disturbed")


class Trial(NamedTuple):
    """A recording of K rows."""

    name: str  # "02"
    rate: float  # [Hz]
    gyro: np.ndarray  # (K, 3) [rad/s]
    z: np.ndarray  # (K, 6), accelerometer [m/s^2], magnetometer [uT]
    reference: np.ndarray  # (K, 4), quaternions from the sensor to east, north, up; NaN where there is none
    moves: np.ndarray  # (K,) bool


class Errors(NamedTuple):
    """Root mean squares [deg]."""

    total: float
    inclination: float
    heading: float

    @classmethod
    def mean(cls, errors: Sequence[Errors]) -> Errors:
        """The mean over trials, as BROAD has it."""
        return cls(*np.mean(errors, axis=0).tolist())

    def __str__(self) -> str:
        return " / ".join(f"{value:.2f}" for value in self)


def read_trials(folder: str | Path) -> dict[str, Trial]:
    """The trials named above that a folder has, by name, from BROAD's MATLAB files.

    Args:
        folder: of the files, or with a folder data_mat.

    Raises:
        ValueError: if a training or a held-out trial is missing altogether, or a file has other arrays.
    """
    folder = Path(folder)
    folder = folder / "data_mat" if (folder / "data_mat").is_dir() else folder
    trials = {}
    for name in (*TRAINING, *HELD_OUT, *DISTURBED):
        for path in sorted(folder.glob(f"{name}_*.mat")):
            trials[name] = read_trial(path)
    for names in (TRAINING, HELD_OUT):
        if not set(names) & set(trials):
            rule = f"a folder of BROAD must have one of trials {', '.join(names)} as NAME_*.mat"
            raise ValueError(f"{rule}, but {folder} has none")
    return trials


def read_trial(path: Path) -> Trial:
    """A trial of a MATLAB file; ValueError if it has other arrays."""
    arrays = arrays_of(path)
    for name in (*ARRAYS, "movement", "sampling_rate"):
        shape = getattr(arrays.get(name), "shape", None)
        if shape is None or (name in ARRAYS and (len(shape) != 2 or shape[1] != ARRAYS[name])):
            rule = f"a trial of BROAD must have an array {name} of {ARRAYS.get(name, 1)} columns"
            raise ValueError(f"{rule}, but {path} has {'none' if shape is None else shape}")
    gyro, acc, mag, reference = (np.asarray(arrays[name][...], dtype=np.float64) for name in ARRAYS)
    moves = np.ravel(arrays["movement"][...]).astype(bool)
    rate = float(np.ravel(arrays["sampling_rate"][...])[0])
    return Trial(path.name.partition("_")[0], rate, gyro, np.hstack([acc, mag]), reference, moves)


def errors(estimated: np.ndarray, reference: np.ndarray, counts: np.ndarray) -> Errors:
    """The three errors of quaternions (K, 4) in the rows that count (K,) and have a reference."""
    rows = counts & ~np.isnan(reference).any(axis=1)
    w, x, y, z = map(np.asarray, rotations.product(estimated[rows].T, rotations.inverse(tuple(reference[rows].T))))
    angles = (
        2.0 * np.arctan2(np.sqrt(x**2 + y**2 + z**2), np.abs(w)),
        2.0 * np.arctan2(np.hypot(x, y), np.hypot(w, z)),
        2.0 * np.arctan2(np.abs(z), np.abs(w)),
    )
    return Errors(*(float(np.degrees(np.sqrt(np.mean(angle**2)))) for angle in angles))


def filtered(trial: Trial, numbers: Mapping[str, float]) -> Errors:
    """Errors of the extended Kalman filter of `attitude` with such numbers, from the attitude of the first row."""
    model = attitude(1.0 / trial.rate, **numbers)
    begun = model.replace(prior_mean=begun_at(model, trial.z[:1])[0])
    ekf = filters.ExtendedKalmanFilter(model=begun)
    means = filters.run(ekf, inputs=trial.gyro[1:], measurements=trial.z).means
    return errors(means[:, :4], trial.reference, trial.moves)


def identified(trials: Mapping[str, Trial], free: Sequence[str] = FREE) -> dict[str, float]:
    """The numbers of maximum likelihood on the first motion of the training trials, without their reference."""
    tables = []
    for name in TRAINING:
        if name in trials:
            trial, first = trials[name], int(np.argmax(trials[name].moves))
            rows = slice(max(first - int(BEFORE * trial.rate), 0), first + int((SECONDS - BEFORE) * trial.rate))
            values = np.hstack([trial.gyro, trial.z])[rows]
            symbols = [f"{sensor}_{axis}" for sensor in ("gyr", "acc", "mag") for axis in "xyz"]
            columns = dict(zip(symbols, values.T, strict=True))
            tables.append({"time": np.arange(len(values)) / trial.rate, **columns})
    start = {"field": float(np.linalg.norm(values[0, 6:]))}
    result = maximum_likelihood(
        ("attitude", tables), list(free), use_all=True, starts=1, start=start, progress=False
    )
    return {name: float(result.values[name]) for name in free}


class Row(NamedTuple):
    """A filter's errors by trial."""

    name: str
    numbers: Mapping[str, float]
    by_trial: Mapping[str, Errors]

    @classmethod
    def of(cls, name: str, trials: Mapping[str, Trial], numbers: Mapping[str, float]) -> Row:
        """The filter of some numbers on all trials."""
        return cls(name, numbers, {key: filtered(trial, numbers) for key, trial in trials.items()})

    def over(self, names: Sequence[str]) -> Errors | None:
        """The mean over trials; None where none of them is there."""
        known = [self.by_trial[name] for name in names if name in self.by_trial]
        return Errors.mean(known) if known else None


def rows(trials: Mapping[str, Trial], numbers: Mapping[str, float] = NUMBERS) -> list[Row]:
    """The filter with the model's own gyroscope, and with that of least error on the training trials."""
    training = {name: trials[name] for name in TRAINING if name in trials}

    def total(gyroscope: float) -> float:
        errors = Row.of("", training, {**numbers, "gyroscope": gyroscope}).over(TRAINING)
        assert errors is not None  # `read_trials` demands one
        return errors.total

    best = min(GYROSCOPES, key=total)
    chosen = f"ekf, gyroscope {best:g}, chosen on the training trials' reference"
    first = Row.of(f"ekf, gyroscope {GYROSCOPE:g}", trials, dict(numbers))
    return [first, Row.of(chosen, trials, {**numbers, "gyroscope": best})]


def tables_of(computed: Sequence[Row]) -> dict[str, Table]:
    """Errors over groups of trials beside those of other filters, and the first row's errors by trial."""
    groups = TRAINING, HELD_OUT, DISTURBED
    cells = [[row.name, *(str(row.over(names) or "") for names in groups)] for row in computed]
    cells += [[name, *(str(Errors(*errors)) for errors in of_groups)] for name, of_groups in OTHERS.items()]
    first = computed[0]
    by_trial = [[name, *(f"{value:.2f}" for value in errors)] for name, errors in first.by_trial.items()]
    return {
        "broad": Table("total / inclination / heading error in motion [deg]", HEADER, cells),
        "broad_trials": Table(f"errors by trial [deg], {first.name}", ("trial", *Errors._fields), by_trial),
    }


def reproduce(data: Annotated[Path, Option(INPUT)], identify: Annotated[bool, Option(RUNS)] = False) -> Printed:
    """Filter BROAD's trials with the model `attitude`, and compare with the reference of motion capture.

    The recordings are those of Laidig et al. (2021), github.com/dlaidig/broad, which are not part of this project.

    Example: thruster reproduce broad --data broad

    Args:
        data: a clone of BROAD's repository, or a folder of its .mat files.
        identify: find the numbers of the model again, on the training trials without their reference: a minute.
    """
    trials, numbers = read_trials(data), dict(NUMBERS)
    if identify:
        with progress_of("identifying") as progress:
            progress("", 0, 1)
            numbers = identified(trials)
    computed = rows(trials, numbers)
    listed = ", ".join(f"{name} {value:.4g}" for name, value in numbers.items())
    named = {row.name: {name: errors._asdict() for name, errors in row.by_trial.items()} for row in computed}
    return Printed([*tables_of(computed).values(), f"Numbers: {listed}."], {"numbers": numbers, "errors": named})


def tables_from(data: Path) -> dict[str, Callable[[], str]]:
    """The tables of docs/attitude.md by name, from BROAD's folder."""
    return {name: table.on_page for name, table in tables_of(rows(read_trials(data))).items()}
