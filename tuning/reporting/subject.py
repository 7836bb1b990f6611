"""The subject of a report: a tuned file with its study, or a study alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import optuna

from filters.tuned_file import read_tuned_file
from thruster_env.core.checks import at_least, short_repr
from tuning.evaluation.held_out import versions
from tuning.evaluation.tuned import problem_in, read_tuned
from tuning.problems.find import find_given
from tuning.problems.problem import Problem
from tuning.search.among_types import SIZES
from tuning.search.plan import HELD_OUT_SEEDS, Plan
from tuning.search.space import Choice
from tuning.search.storage import open_storage, public_url
from tuning.search.study import chosen_of
from tuning.search.trials import best_trial, is_consistent
from tuning.search.validation import choice_from


class Subject(NamedTuple):
    """A choice and its source."""

    name: str  # of the study
    plan: Plan
    choice: Choice
    study: optuna.Study | None  # None where it is not in the storage
    seeds: int  # number of held-out seeds
    chosen: bool  # whether the ensemble size is that of a tuned file, or still to be chosen
    consistent: bool = False  # whether its mean NIS is in its band, where it has to be
    content: Mapping = {}  # of the tuned file
    sizes: object = None  # the table of ensemble sizes as it is kept
    validation: Mapping | None = None  # how the best trials met the baselines: `validation.as_data`
    nis: tuple[float, ...] = ()  # mean NIS over the channels on each scenario's training seeds, where it is kept


def find_subject(source: str | Path, storage: str, problems: Sequence[Problem] = ()) -> Subject:
    """The subject of a report.

    Args:
        source: a tuned file (what ends in .json, or is a file), or the name of a study.
        storage: where the study is; a tuned file may come without.
        problems: what it is of, where that is code: nothing that a file or a study names is imported.

    Raises:
        ValueError: if the tuned file is refused, or there is no such study or none of its trials is complete.
    """
    return (_of_file if is_file(source) else _of_study)(str(source), storage, problems)


def is_file(source: str | Path) -> bool:
    """Whether a source stands for a tuned file."""
    return Path(source).suffix == ".json" or Path(source).is_file()


def _of_file(path: str, storage: str, problems: Sequence[Problem]) -> Subject:
    content, (choice, scenario, _) = read_tuned_file(path), read_tuned(path, problems)
    name, plan = (
        str(content["study"].get("name")),
        _plan(content["study"], path, partial(problem_in, content, path=path, problems=problems)),
    )
    study = _load(name, storage)
    if study is not None and study.user_attrs.get("identity") != plan.identity:
        study = None  # another study of the same name
    try:
        first, beyond = content["held_out"][scenario.name]["seeds"]
        count = at_least("the number of held-out seeds", beyond - first, 2)
    except (KeyError, TypeError):
        raise ValueError(f"a tuned file must contain its held-out seeds, but {path} does not") from None
    consistent = plan.is_constrained and bool(content["study"].get("any_trial_consistent"))
    stored = content if content.get("digest") == plan.scenarios[0].digest else {}
    sizes, nis = content.get("ensemble_sizes"), kept_nis(stored, plan)
    met = content.get("choice")
    return Subject(name, plan, choice, study, count, True, consistent, stored, sizes, met, nis)


def kept_nis(content: Mapping, plan: Plan) -> tuple[float, ...]:
    """The mean NIS on the training seeds in a tuned file; nothing if it was made with other packages."""
    ratios = content.get("study", {}).get("mean_nis") if content.get("made_with") == versions() else None
    if not isinstance(ratios, list) or len(ratios) != len(plan.scenarios):
        return ()
    return tuple(ratios) if all(isinstance(ratio, float) for ratio in ratios) else ()


def _of_study(name: str, storage: str, problems: Sequence[Problem]) -> Subject:
    study = _load(name, storage)
    if study is None:
        where = public_url(storage)
        raise ValueError(f"a report must be of a tuned file or of a study in {where}, but got {name!r}")
    where = f"study {name!r}"
    plan = _plan(study.user_attrs.get("identity"), where, partial(find_given, problems=problems, where=where))
    best = best_trial(study.get_trials(deepcopy=False))
    if best is None:
        raise ValueError(f"a study must have a complete trial for a report, but {name!r} has none")
    choice, met = plan.choice_of(best.params), chosen_of(study)
    if met is not None:
        contender = next(contender for contender in met["met"] if contender["name"] == met["chosen"])
        choice = choice_from(contender["choice"])
    consistent = plan.is_constrained and is_consistent(best)
    chosen, sizes = len(plan.objectives) > 1 or met is not None, study.user_attrs.get(SIZES)
    return Subject(name, plan, choice, study, HELD_OUT_SEEDS, chosen, consistent, sizes=sizes, validation=met)


def _load(name: str, storage: str) -> optuna.Study | None:
    """A study by name, None if it does not exist; no storage is created."""
    if "://" not in storage and not Path(storage).is_file():
        return None
    try:
        return optuna.load_study(study_name=name, storage=open_storage(storage))
    except KeyError:
        return None


def _plan(identity, where: str | Path, find: Callable[[str], Problem]) -> Plan:
    """The plan of an identity, its scenarios found by name."""
    try:
        scenarios = tuple(find(name) for name in identity["scenarios"])
        objectives, seed = tuple(identity["objectives"]), at_least("seed", identity["seed"], 0)
        plan = Plan(
            identity["filter"],
            scenarios,
            seed,
            objectives,
            identity["consistent"],
            identity["sampler"],
            identity["hold_r"],
            budget=identity["budget"],
            full_q=identity["full_q"],
            full_r=identity.get("full_r", False),
            where=tuple(identity.get("where", ())),
            worst=identity.get("worst", False),
            forget=identity.get("forget"),
        )
    except (KeyError, TypeError):
        raise ValueError(f"a report needs the plan of the study, but {where} has {short_repr(identity)}") from None
    return plan.checked()
