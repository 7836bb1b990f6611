"""Results of all identifications, stored in a file one by one, so that an interrupted study can be continued."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from thruster_env.core.files import write_whole
from tuning.experiments.recordings.identification import CHOSEN, STRUCTURES, identified
from tuning.experiments.recordings.runs import Recording
from tuning.problems.digest import digest_of

NONE_HELD_OUT = ""


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
        tuple(run.log(True).digest for run in runs), [(*one,) for one in STRUCTURES.values()], starts
    )
    kept = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    found = kept["tasks"] if kept.get("digest") == digest else {}
    tasks = tasks_of(runs)
    for number, task in enumerate(tasks):
        if progress is not None:
            progress(task.name, number, len(tasks))
        if task.name in found:
            continue
        some = [one for one in runs if one.name != task.held_out]
        first = task == Task(CHOSEN)
        learnt = identified(STRUCTURES[task.structure], some, starts if first else 1)
        if learnt.interrupted:
            raise KeyboardInterrupt
        found[task.name] = {
            "values": learnt.values,
            "standard_errors": learnt.standard_errors,
            "determined": learnt.determined,
            "log_likelihood": learnt.log_likelihood,
            "agreement": [learnt.agreement, len(learnt.optima)],
            "sentences": learnt.sentences(),
        }
        write_whole(file, json.dumps({"digest": digest, "tasks": found}, indent=1))
    return found
