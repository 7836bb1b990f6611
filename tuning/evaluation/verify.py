"""Verification of a tuned file: its held-out metrics, recomputed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from filters.tuned_file import read_tuned_file
from thruster_env.core.checks import short_repr
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import metrics, problem_in, read_tuned
from tuning.evaluation.versions import versions
from tuning.problems.problem import Problem

TOLERANCE = 1e-9  # relative: the effect of the order of a sum
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


class Verification(NamedTuple):
    """The result of recomputing a tuned file's metrics."""

    checked: int  # numbers that were compared
    differences: list[Difference]  # beyond rounding, the largest first
    packages: dict[str, tuple[str, str]]  # of another version here: version in the file, and installed version

    @property
    def holds(self) -> bool:
        """Whether every number is the same within rounding."""
        return not self.differences


def verify(path: str | Path, problems: Sequence[Problem] = ()) -> Verification:
    """Recompute the held-out metrics of a tuned file, on its seeds of each scenario.

    Args:
        path: the tuned file.
        problems: the problems it was tuned on, if these are code: names in a file are never imported.

    Raises:
        ValueError: if the file is not a complete, unchanged tuned file, or has no metrics.
    """
    content, (choice, _, seed) = read_tuned_file(path), read_tuned(path, problems)
    held_out = content.get("held_out")
    if not isinstance(held_out, dict) or not held_out:
        raise ValueError(
            f"a tuned file must have held-out metrics to verify, but {path} has {short_repr(held_out)}"
        )
    places, differences = 0, []
    for name, stored in held_out.items():
        comparison = evaluate_held_out(
            choice, problem_in(content, name, path, problems), seed, _count(stored, path)
        )
        pairs = _numbers(stored), _numbers(_as_old_as(stored, metrics(comparison)))
        names = list(dict.fromkeys([*pairs[0], *pairs[1]]))
        differing = [Difference(f"{name}: {place}", *(part.get(place) for part in pairs)) for place in names]
        places += len(names)
        differences += [one for one in differing if one.stored != one.found and not one.relative <= TOLERANCE]
    differences.sort(key=lambda difference: -difference.relative)
    stored_versions, here = content.get("made_with", {}), versions()
    packages = {
        name: (stored_versions.get(name, "not stored"), version)
        for name, version in here.items()
        if stored_versions.get(name) != version
    }
    return Verification(places, differences, packages)


def _as_old_as(stored: Any, found: Any) -> Any:
    """What was found, without keys that came later than the file."""
    if not (isinstance(stored, dict) and isinstance(found, dict)):
        return found
    known = {key: value for key, value in found.items() if key in stored or key not in LATER}
    return {key: _as_old_as(stored.get(key), value) for key, value in known.items()}


def _count(stored, path: str | Path) -> int:
    """Number of held-out seeds of a scenario's entry."""
    try:
        first, beyond = stored["seeds"]
        return beyond - first
    except (KeyError, TypeError, ValueError):
        raise ValueError(
            "held-out metrics of a tuned file must give their first seed and the one after the last, but "
            f"{path} has {short_repr(stored)}"
        ) from None


def _numbers(value, place: str = "") -> dict[str, Any]:
    """All values within nested mappings and lists, by their path."""
    return dict(_leaves(value, place))


def _leaves(value, place: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict | list | tuple):
        parts = value.items() if isinstance(value, dict) else enumerate(value)
        for key, part in parts:
            yield from _leaves(part, f"{place} {key}".strip())
    else:
        yield place, value
