"""The filters of each paper's study, with their paths and worlds."""

from __future__ import annotations

from thruster_env.core.checks import one_of
from tuning.experiments import ngatini2017, ngatini2019
from tuning.experiments.vehicle.estimators import ensembles, fuzzy, kalman, measured
from tuning.experiments.vehicle.experiment import Task
from tuning.experiments.vehicle.printed import Paper

PAPERS: dict[str, Paper] = {module.PAPER.name: module.PAPER for module in (ngatini2017, ngatini2019)}
OTHER_WORLD = "no restoring moments"


def tasks_of(paper: str) -> list[Task]:
    """The tasks of "ngatini2017" or "ngatini2019"; ValueError for another name."""
    if one_of("paper", paper, tuple(PAPERS)) == ngatini2019.PAPER.name:
        return [Task("IV", "vehicle", [measured(), *kalman(), *ensembles(8)])]
    (printed, *others), ekf8, enkf = fuzzy(), kalman()[0], ensembles(8, members=(ngatini2017.MEMBERS,))[0]
    few = [measured(), ekf8, enkf, printed]
    paths = [Task(name, "vehicle", few) for name in ("I", "II", "III")]
    paths += [Task(name, "vehicle", [*few, *others]) for name in ("IV", "dynamic")]
    ekf8, _, ekf6, _ = kalman(OTHER_WORLD)
    there = [measured(), ekf8, ekf6, *ensembles(6, OTHER_WORLD), *fuzzy(OTHER_WORLD)]
    return [*paths, Task("dynamic", OTHER_WORLD, there)]
