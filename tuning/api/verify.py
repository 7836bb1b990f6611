"""`tuning.verify` and `thruster verify`: whether the metrics in a tuned file hold."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import RenderableType

from filters.tuned_file import read_tuned_file
from thruster_env.core.checks import short_repr
from thruster_env.core.parallel import task_map
from thruster_env.core.text_tables import Table
from tuning.api.markers import CodeProblem, ExecutorOption, Model, Preset, Progress, TunedFile
from tuning.api.problems import given_for
from tuning.api.progress import console_for, working
from tuning.api.result import Result, plain_data
from tuning.evaluation.held_out import evaluate_held_out, versions
from tuning.evaluation.tuned import metrics, problem_in, read_tuned

TOLERANCE = 1e-9  # relative: the effect of the order of a sum
LISTED = 10  # differences in the table; --json has all
LATER = (
    "scaled",
    "scaled_default",
    "given",
    "noise",
    "log_score",
    "restarts",
    "state_nees",
    "time_constants",
    "oracle",
    "advised",
    "uneven",
)  # keys that older files lack


class Difference(NamedTuple):
    """A number of a tuned file that differs from the recomputed one."""

    place: str  # such as "mismatch: tuned nees 0"
    stored: Any
    found: Any

    @property
    def relative(self) -> float:
        """The difference over the larger magnitude; infinite if one of them is not a number."""
        if not isinstance(self.stored, int | float) or not isinstance(self.found, int | float):
            return float("inf")
        return abs(self.stored - self.found) / max(abs(self.stored), abs(self.found))


@dataclass(frozen=True)
class Verification(Result):
    """The result of recomputing a tuned file's metrics.

    Attributes:
        file: the tuned file.
        checked: number of numbers that were compared.
        differences: beyond rounding, the largest first.
        packages: of another version here: version in the file, and installed version.
    """

    file: str
    checked: int
    differences: list[Difference]
    packages: dict[str, tuple[str, str]]

    @property
    def holds(self) -> bool:
        """Whether every number is the same within rounding."""
        return not self.differences

    @property
    def exit_code(self) -> int:
        """Of the command: 1 if a number differs."""
        return int(not self.holds)

    def tables(self) -> list[RenderableType]:
        """Whether the numbers hold, the largest differences, and packages of other versions."""
        output: list[RenderableType] = [
            f"{self.file} holds: {self.checked} numbers are the same within {TOLERANCE:g} of their size."
        ]
        if not self.holds:
            rows = [[d.place, str(d.stored), str(d.found), f"{d.relative:.1e}"] for d in self.differences[:LISTED]]
            output = [f"{self.file} does not hold: {len(self.differences)} of {self.checked} numbers differ."]
            output.append(Table("The largest differences", ["number", "stored", "found", "relative"], rows))
        if self.packages:
            changes = ", ".join(f"{name} {then} then, {now} now" for name, (then, now) in self.packages.items())
            output.append(f"Packages whose versions have changed since the file was made: {changes}.")
        return output

    def as_dict(self) -> dict[str, Any]:
        """All results as plain data, as in `thruster verify --json`."""
        data = {
            "file": self.file,
            "holds": self.holds,
            "checked": self.checked,
            "differences": [{**d._asdict(), "relative": d.relative} for d in self.differences],
            "packages": {name: {"stored": then, "here": now} for name, (then, now) in self.packages.items()},
        }
        return plain_data(data)


def verify(
    tuned: TunedFile,
    *,
    problem: CodeProblem = None,
    model: Model = None,
    preset: Preset = None,
    executor: ExecutorOption = None,
    progress: Progress = None,
) -> Verification:
    """Recompute the held-out metrics of a tuned file on its seeds, and say whether they hold.

    They hold if every number is the same within rounding; the exit code is then 0, otherwise 1. Packages
    whose versions have changed since the file was made are named.

        tuning.verify("tuned.json").holds

    Example: thruster verify out/enkf-mismatch-seed0.json

    Args:
        tuned: tuned file, as `thruster tune` writes it.
        problem: the problem it was tuned on, if that is code: names in files and studies are never imported. In
            Python also a `Problem`.
        model: the model of the logs that it was tuned on, if that is code. In Python also what makes or offers
            one.
        preset: the preset with which it was tuned, by default as the tuned file names it:
        executor: where parts run: in N processes, in those of `mpirun`, or on a Dask scheduler's workers; in this
            process by default. In Python also any `concurrent.futures.Executor`.
        progress: whether to show progress; by default only in terminals and notebooks.

    Raises:
        ValueError: if the file is not a complete, unchanged tuned file, or has no metrics.
    """
    console = console_for(progress)
    with task_map(executor) as tasks, working(f"recomputing the metrics of {tuned}", console):
        problems = given_for(tuned, problem, model, preset)
        content, (choice, _, seed) = read_tuned_file(tuned), read_tuned(tuned, problems)
        held_out = content.get("held_out")
        if not isinstance(held_out, dict) or not held_out:
            raise ValueError(
                f"a tuned file must have held-out metrics to verify, but {tuned} has {short_repr(held_out)}"
            )
        count, differences = 0, []
        for name, stored in held_out.items():
            scenario = problem_in(content, name, tuned, problems)
            comparison = evaluate_held_out(choice, scenario, seed, _count(stored, tuned), tasks)
            pairs = _numbers(stored), _numbers(_as_old_as(stored, metrics(comparison)))
            names = list(dict.fromkeys([*pairs[0], *pairs[1]]))
            differing = [Difference(f"{name}: {key}", *(part.get(key) for part in pairs)) for key in names]
            count += len(names)
            differences += [d for d in differing if d.stored != d.found and not d.relative <= TOLERANCE]
    differences.sort(key=lambda difference: -difference.relative)
    stored_versions, here = content.get("made_with", {}), versions()
    packages = {
        name: (stored_versions.get(name, "not stored"), version)
        for name, version in here.items()
        if stored_versions.get(name) != version
    }
    return Verification(str(tuned), count, differences, packages)


def _as_old_as(stored: Any, recomputed: Any) -> Any:
    """The recomputed metrics without keys that came later than the file."""
    if not (isinstance(stored, dict) and isinstance(recomputed, dict)):
        return recomputed
    known = {key: value for key, value in recomputed.items() if key in stored or key not in LATER}
    return {key: _as_old_as(stored.get(key), value) for key, value in known.items()}


def _count(stored, path: str | Path) -> int:
    try:
        first, beyond = stored["seeds"]
        return beyond - first
    except (KeyError, TypeError, ValueError):
        raise ValueError(
            "held-out metrics of a tuned file must give their first seed and the one after the last, but "
            f"{path} has {short_repr(stored)}"
        ) from None


def _numbers(value: Any, path: str = "") -> dict[str, Any]:
    """All values within nested mappings and lists, by their path."""
    if not isinstance(value, dict | list | tuple):
        return {path: value}
    parts = value.items() if isinstance(value, dict) else enumerate(value)
    by_part = [_numbers(part, f"{path} {key}".strip()) for key, part in parts]
    return {name: leaf for leaves in by_part for name, leaf in leaves.items()}
