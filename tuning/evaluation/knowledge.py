"""The noise and constants that filters of a comparison assume."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from filters.registry import filter_type
from thruster_env.core.progress import tell
from tuning.evaluation.baselines import (
    GIVEN,
    NOISE,
    RULE,
    SCALED,
    competing_baselines,
    given_noise,
    noise_estimated,
    oracle,
    rule_of_thumb,
    scaled_default,
)
from tuning.evaluation.residuals import model_error
from tuning.problems.problem import Problem
from tuning.search.measures import measured
from tuning.search.objectives import LIKELIHOOD, SCORE
from tuning.search.parameters import ensemble_sizes_of
from tuning.search.plan import Plan
from tuning.search.space import Choice, has_search_space
from tuning.search.storage import quiet_optuna
from tuning.search.study import open_study, run_trials
from tuning.search.trials import best_trial

OF_FILE, OF_FILTER, STUDY = "tuned", "own", "study"
STUDY_TRIALS = 20  # of a comparison's study, if no number is given
TUNING = "tuning"  # how the progress of such a study begins
# The one explanation of `knows`: that of the command's help, of the docstring of `tuning.compare` and of the docs.
KNOWS = (
    "the Q and R of named filters: true (the plant's own, the oracle), scaled (the scaled default), untuned (the "
    "rule of thumb), given (the model's own), noise (noise estimation) or study (the best on the training seeds "
    f"of a study of {STUDY_TRIALS} trials and all of these but the oracle; ensemble sizes are not tuned). By "
    "default true, but study if the model's residuals on true states are not white with the plant's Q and R, for "
    "nobody would use these with a wrong model; rows that estimate further constants keep true. If the plant's Q "
    "and R are unknown, scaled, or for a filter without a scaled default the first that it has of given, noise "
    "and untuned."
)
SAID = {
    "true": "the plant's own (oracle; {option} true)",
    "scaled": "the scaled default ({option} scaled)",
    "untuned": "the rule of thumb ({option} untuned)",
    "given": "those that the model came with ({option} given)",
    "noise": "noise estimation ({option} noise)",
    STUDY: "the best trial of a study ({option} study)",
    OF_FILE: "the tuned ones",
    OF_FILTER: "those of the filter itself",
}
KNOWLEDGE = ("true", "scaled", "untuned", "given", "noise", STUDY)  # of Q and R; see `KNOWS`
OF_BASELINE = {SCALED: "scaled", RULE: "untuned", GIVEN: "given", NOISE: "noise"}


class Known(NamedTuple):
    """A filter's choice on a problem, and the source of its Q and R."""

    choice: Choice
    source: str  # one of `KNOWLEDGE`; empty for a filter without a covariance
    note: str = ""  # why it is this one, in a sentence


def known(
    knows: str | None,
    name: Any,
    problem: Problem,
    seed: int = 0,
    trials: int = STUDY_TRIALS,
    ensemble_size: int | None = None,
) -> Known:
    """The choice of a filter with some knowledge, by default as `KNOWS` has it.

    Args:
        knows: one of `KNOWLEDGE`, or None.
        name: of the filter.
        problem: what it is compared on.
        seed: of the study whose training runs determine the scaled default, noise estimation and the study.
        trials: of the study ...
        ensemble_size: ... and its N; that of the rule of thumb if None.

    Raises:
        ValueError: if the knowledge is named, and the filter cannot have it on this problem.
        KeyboardInterrupt: after Ctrl-C during the study.
    """
    if knows is not None:
        return _named(knows, name, problem, seed, trials, ensemble_size)
    if problem.true is not None:
        error = model_error(problem, seed)
        if not error:
            return _named("true", name, problem, seed, trials, ensemble_size)
        studied = _studied(name, problem, seed, trials, ensemble_size)
        return studied._replace(note=f"Model and plant differ: {error}.") if studied.source else studied
    default = scaled_default(name, problem, seed, ensemble_size)
    if default.choice is not None:
        return Known(default.choice, "scaled")
    choices = {"given": given_noise(name, problem), "noise": noise_estimated(name, problem, seed)}
    choices["untuned"] = rule_of_thumb(name, problem)
    source, choice = next((key, candidate) for key, candidate in choices.items() if candidate is not None)
    if not filter_type(name).has_covariance:
        return Known(choice, "")
    return Known(choice, source, f"There is no scaled default: {default.reason}.")


def _named(knows: str, name: Any, problem: Problem, seed: int, trials: int, ensemble_size: int | None) -> Known:
    """The choice of a filter with this knowledge; ValueError where there is none."""
    if knows == STUDY:
        return _studied(name, problem, seed, trials, ensemble_size)
    if knows == "untuned":
        return Known(rule_of_thumb(name, problem), knows)
    if knows == "scaled":
        default = scaled_default(name, problem, seed, ensemble_size)
        if default.choice is None:
            raise ValueError(f"{name} must have a scaled default on {problem.name}, but {default.reason}")
        return Known(default.choice, knows)
    if knows == "noise":
        choice, rule = noise_estimated(name, problem, seed), "noise estimation needs true states of all states"
    elif knows == "given":
        choice, rule = (
            given_noise(name, problem),
            "given Q and R must be those of a user's model or of its parameters",
        )
    else:
        choice, rule = oracle(name, problem), "an oracle must know the plant's Q and R"
    if choice is None:
        raise ValueError(f"{rule}, but {problem.name} has none: take one of {', '.join(KNOWLEDGE)}")
    return Known(choice, knows)


@lru_cache(maxsize=64)
def _studied(name: Any, problem: Problem, seed: int, trials: int, ensemble_size: int | None) -> Known:
    """The best on the training seeds of a study's best trial and the baselines but the oracle, all of one N.

    An estimator of another package has no study, nor has a class that no name stands for.
    """
    kind = filter_type(name)
    if kind.is_estimator or not isinstance(name, str) or not has_search_space(name):
        noise = noise_estimated(name, problem, seed)
        return Known(rule_of_thumb(name, problem), "") if noise is None else Known(noise, "noise")
    size = (ensemble_size or ensemble_sizes_of(kind).untuned) if kind.has_ensemble else None
    objective = LIKELIHOOD if problem.scale is None else SCORE
    plan = Plan(name, (problem,), seed, (objective,), ensemble_size=size)
    tell(f"{TUNING} {name} on {problem.name}")
    data = plan.training_data()
    with quiet_optuna():
        study = open_study(STUDY, plan)
        if run_trials(study, plan, data, trials):
            raise KeyboardInterrupt
    choices = {OF_BASELINE[key]: choice for key, choice in competing_baselines(name, problem, seed, size).items()}
    best = best_trial(study.trials)
    if best is not None:
        choices[STUDY] = plan.choice_of(best.params)
    values = {key: measured(choice, plan, data).value for key, choice in choices.items()}
    source = min(values, key=lambda key: values[key])
    return Known(choices[source], source if kind.has_covariance else "")


def noise_sentence(rows: Sequence[Any], option: str = "knows") -> str:
    """The source of the Q and R of the filters in a comparison, and why; empty if not stated.

    Args:
        rows: with a label, the source of the filter's Q and R, and a note on it.
        option: the user's name for the choice among these.
    """
    groups: dict[str, list[str]] = {}
    for row in rows:
        if row.knows:
            groups.setdefault(SAID[row.knows].format(option=option), []).append(row.label)
    if not groups:
        return ""
    notes = "".join(dict.fromkeys(f" {row.note}" for row in rows if row.note))
    if len(groups) == 1:
        return f"Q and R: {next(iter(groups))}.{notes}"
    parts = [f"of {', '.join(labels)} {words}" for words, labels in groups.items()]
    return f"Q and R: {'; '.join(parts)}.{notes}"


def belief_sentences(rows: Sequence[Any]) -> list[str]:
    """The prior of each constant that filters estimate, the same for all filters, a sentence per constant."""
    beliefs = {name: belief for row in rows for name, belief in row.beliefs.items()}
    return [
        f"{name} has a prior mean of {belief.mean:.4g}, a standard deviation of {belief.std:.3g} and a random "
        f"walk of {belief.walk_std:.3g} per step (standard deviation; all in its own unit)."
        for name, belief in beliefs.items()
    ]
