"""A way of tuning as a study: the values on its path are the trials, and its result is the choice."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import optuna
from optuna.trial import FrozenTrial

from filters.registry import filter_type
from tuning.evaluation.baselines import noise_estimated, same_filter
from tuning.likelihood.goal import OF_STATES
from tuning.problems.data import Data
from tuning.search.interruption import stop_on_interrupt
from tuning.search.measures import measured
from tuning.search.objectives import reported, reported_name
from tuning.search.parameters import R
from tuning.search.plan import Plan
from tuning.search.space import (
    AUTO,
    Choice,
    given_choice,
    oracle_choice,
    trial_parameters,
    untuned_choice,
    within_ranges,
)
from tuning.search.study import FINISHED, OnTrial, StudyResult
from tuning.search.trials import run_trial
from tuning.ways.registry import WAYS, find_way
from tuning.ways.task import Budget, Refused, Task

ANSWER = "answer of the way"  # attribute of a study


class Followed(NamedTuple):
    """The result of a way, and its cost."""

    name: str
    choice: Choice
    runs: float  # passes of the filter over one run each
    seconds: float  # of processor time, without compilation
    refused: Refused | None = None  # where the choice is what the way was given


def check_way(plan: Plan, name: str, workers: int) -> None:
    """Raise ValueError for an unknown way, or a plan that ways do not support."""
    find_way(name)
    if plan.worst:
        raise ValueError("a way (--way) must minimise the mean over problems, but got worst (--worst)")
    if plan.budget is not None or plan.filter == AUTO:
        raise ValueError("a way (--way) must have one filter, and no budget of microseconds per step")
    if len(plan.objectives) > 1:
        raise ValueError(f"a way (--way) must have one objective, but got {list(plan.objectives)}")
    if workers > 1:
        raise ValueError(f"workers (--workers) must be 1 with a way (--way), but got {workers}")


def follow(
    study: optuna.Study, plan: Plan, data: Sequence[Data], trials: int, on_trial: OnTrial, *, name: str
) -> bool:
    """Run a way to its end, or one that samples trials for as many as a study has: `run` of `run_study`.

    Returns:
        Whether Ctrl-C ended it; its results so far are kept.

    Raises:
        ValueError: if the plan lacks what the way needs.
    """
    if ANSWER in study.user_attrs:
        return False
    options = plan.options if filter_type(plan.filter).has_covariance else {}
    with stop_on_interrupt() as interrupted:
        given: dict[str, Any] = {"options": options, "objective": plan.objectives[0]}
        passes = sum(len(one.seeds) for one in data)
        given["budget"] = Budget(trials * passes) if find_way(name).by_trials else Budget()
        task = Task(plan.filter, plan.scenarios, data, start=_start(plan, name), given=_given(plan), **given)
        task.seed, task.stop = plan.seed, interrupted
        find_way(name).run(name, task)
        stopped = interrupted()
    space = plan.space()
    path = task.kept[1:] if task.refused is None else task.kept[1:-1]
    for choice in _some([one.choice for one in path], trials - 1):
        study.enqueue_trial(within_ranges(trial_parameters(choice, space), space))
    waiting = len(study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.WAITING,)))

    def after(study: optuna.Study, trial: FrozenTrial) -> None:
        on_trial(study, len(study.get_trials(deepcopy=False, states=FINISHED)))

    study.optimize(lambda trial: run_trial(trial, plan, data, space), n_trials=waiting, callbacks=[after])
    answer = {"choice": task.best._asdict(), "runs": task.runs, "seconds": task.seconds, "refused": task.refused}
    study.set_user_attr(ANSWER, answer)
    return stopped


def _start(plan: Plan, name: str) -> Choice | None:
    """Noise estimation where gradients of an error follow full matrices; None for the rule of thumb.

    From a start far off these often end elsewhere, and from there they do not (docs/ways.md, groups C and D).
    """
    if name not in OF_STATES or not plan.full_q:
        return None
    found = noise_estimated(plan.filter, plan.scenarios[0], plan.seed)
    if found is None or not plan.hold_r and (plan.full_r or np.ndim(found.model[R]) < 2):
        return found
    rule = untuned_choice(plan.filter, plan.scenarios[0]).model[R]
    r = rule if plan.hold_r else tuple(np.diag(np.asarray(found.model[R])).tolist())
    return found._replace(model={**found.model, R: r})


def _given(plan: Plan) -> Choice | None:
    """The model's own numbers; None if there are none, or if they are the plant's, which no study knows."""
    problem = plan.scenarios[0]
    own, true = given_choice(plan.filter, problem), oracle_choice(plan.filter, problem)
    if own is None or (true is not None and same_filter(own, true)):
        return None
    if plan.hold_r and R in own.model:
        own = own._replace(model={**own.model, R: untuned_choice(plan.filter, problem).model[R]})
    return own


def answered(study: optuna.Study, result: StudyResult, plan: Plan, name: str) -> tuple[StudyResult, Followed]:
    """The result of a study by a way, with its answer instead of the best trial, and the way's cost."""
    answer = study.user_attrs[ANSWER]
    found, refused = answer["choice"], answer.get("refused")
    choice = plan.forgetting(Choice(found["name"], _tuples(found["model"]), _tuples(found["numbers"])))
    choice = plan.forgetting(choice, exact=True)
    value = measured(choice, plan, plan.training_data()).value
    nothing: dict[str, Any] = {
        "consistent": None,
        "nis": (),
        "validation": None,
        "sizes": [],
        "sized": None,
        "free_value": None,
    }
    return (
        result._replace(choice=choice, best_value=value, **nothing),
        Followed(name, choice, answer["runs"], answer["seconds"], refused and Refused(*refused)),
    )


def way_sentence(found: Followed, word: str, objective: str) -> str:
    """How the parameters were found, and the cost."""
    way = WAYS[found.name]
    took = f"It took {found.seconds:.2g} s, as long as {found.runs:.0f} runs of the filter over one of the"
    worse = ""
    if found.refused is not None:
        given, answer = (reported(objective, value) for value in found.refused)
        worse = (
            f" On these its answer has a {reported_name(objective)} of {answer:.4g} and the given filter "
            f"{given:.4g}, so that one is returned."
        )
    return f"Way {found.name}: {way.about} ({way.source}). {took} training {word}.{worse}"


def _some(choices: Sequence[Choice], count: int) -> list[Choice]:
    """At most so many of some choices, the last one among them, without two that are the same."""
    if len(choices) <= count or count < 1:
        return list(choices) if count >= 1 else []
    places = sorted({round((i + 1) * len(choices) / count) - 1 for i in range(count)})
    return [choices[place] for place in places]


def _tuples(content: Any) -> Any:
    """What JSON kept, with tuples in place of lists, as choices have it."""
    if isinstance(content, dict):
        return {key: _tuples(value) for key, value in content.items()}
    return tuple(map(_tuples, content)) if isinstance(content, list | tuple) else content
