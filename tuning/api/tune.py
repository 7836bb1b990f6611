"""`tuning.tune` and `thruster tune`: a study from its plan to its held-out evaluation.

In order: the function; methods that run alone, stored as studies; a study from its plan to its evaluation; names.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial
from rich.console import Console

from filters.estimators.foreign import is_foreign, label_of
from filters.registry import filter_type
from thruster_env.core.checks import at_least, short_repr
from thruster_env.core.files import check_target
from tuning.api.markers import (
    FILTER,
    INPUT,
    OUTPUT,
    READ,
    SEARCH,
    WRITTEN,
    FilterOption,
    Group,
    Option,
    ProblemOption,
    Progress,
    Seed,
)
from tuning.api.problems import OF_NUMBERS, problems_of
from tuning.api.progress import console_for, trial_bar, working
from tuning.api.read_logs import read_logs
from tuning.api.study import STUDIES, MethodAnswer, Study
from tuning.evaluation.baselines import noise_estimated, same_filter
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import check_keepable
from tuning.likelihood.gradient import tune_by_gradient
from tuning.likelihood.identifiability import identify
from tuning.likelihood.objective import OF_STATES
from tuning.likelihood.parametric import check_gradient
from tuning.methods.task import DEFAULT, GRADIENT_METHOD, METHODS, ONLY, Budget, Refused, Task, find_method
from tuning.problems.assumed import AssumedProblem, within
from tuning.problems.data import Data
from tuning.problems.find import built_in
from tuning.problems.problem import Problem
from tuning.search.measures import measured
from tuning.search.parameters import R
from tuning.search.plan import HELD_OUT_SEEDS, LIKELIHOOD, SCORE, Plan
from tuning.search.space import (
    AUTO,
    Choice,
    given_choice,
    oracle_choice,
    trial_parameters,
    untuned_choice,
    within_ranges,
)
from tuning.search.storage import open_storage, quiet_optuna, storage_text
from tuning.search.study import (
    FINISHED,
    OnTrial,
    StudyResult,
    answered_by,
    checked,
    finished_trials,
    open_study,
    run_study,
    run_trials,
    stop_on_interrupt,
)
from tuning.search.trials import run_trial
from tuning.search.workers import run_in_workers


@dataclass(frozen=True)
class SearchSpace:
    """Which parameters a study searches, and what they must obey.

    Attributes:
        hold_r: keep R from the sensor's data sheet, tune only Q.
        full_q: tune the correlations of Q, too.
        full_r: tune the correlations of R, too.
        where: a relation that parameters must obey: 'Q22 = 4 Q11', 'Q33 = Q11', 'R = 0.01' (not tuned),
            'Q11 = 1e-6..1e-2' (its range); may be repeated.
        forget: longest time constant of the filter's gain that is allowed; a smaller Q is raised to it.
    """

    hold_r: Annotated[bool, Option(SEARCH)] = False
    full_q: Annotated[bool, Option(SEARCH)] = False
    full_r: Annotated[bool, Option(SEARCH)] = False
    where: Annotated[Sequence[str], Option(SEARCH, metavar="RELATION")] = ()
    forget: Annotated[float | None, Option(SEARCH, metavar="SECONDS")] = None


def tune(
    problem: Annotated[
        Any,
        ProblemOption(
            INPUT,
            ("--problem", "--scenario"),
            type=list[str],
            default=["mismatch"],
            choices="problems",
            file=READ,
            last="augment",
        ),
    ],
    filter: Annotated[str, replace(FilterOption, default="enkf")] = "ekf",
    *,
    space: Annotated[SearchSpace, Group(SearchSpace)] = SearchSpace(),  # noqa: B008 - it is frozen
    budget: Annotated[float | None, Option(FILTER, metavar="MICROSECONDS")] = None,
    trials: Annotated[int, Option(SEARCH)] = 50,
    objective: Annotated[str | Sequence[str] | None, Option(SEARCH, type=list[str], choices="objectives")] = None,
    worst: Annotated[bool, Option(SEARCH)] = False,
    consistent: Annotated[bool, Option(SEARCH, ("--consistency/--no-consistency",))] = True,
    prune: Annotated[bool, Option(SEARCH, ("--pruning/--no-pruning",))] = True,
    method: Annotated[str, Option(SEARCH, choices=METHODS)] = DEFAULT,
    workers: int = 1,
    storage: Annotated[str | Path | None, Option(OUTPUT, default=STUDIES)] = None,
    name: Annotated[str | None, Option(OUTPUT, ("--study",))] = None,
    out: Annotated[str | Path | bool | None, Option(OUTPUT, type=Path, file=WRITTEN, unset=True)] = None,
    seed: Seed = 0,
    progress: Progress = None,
    **reading: Any,
) -> Study:
    """Find the Q, R and ensemble size that give a filter's best estimate, and evaluate it on held-out seeds.

    The score is the mean over states of RMSE over its scale, on 32 training seeds that every trial shares. The
    first trial is the rule of thumb: R from the sensor's data sheet, Q from 1 % of each state's range. Ctrl-C
    keeps all finished trials, and the same command continues the study. The report compares the filter with its
    baselines, first with your model's own Q and R, on 200 seeds that no trial saw.

        study = tuning.tune("mismatch", filter="enkf", trials=50)
        study.save("tuned.json")
        study.plot_errors()

        study = tuning.tune((model, ["run1.csv", "run2.csv"]), trials=100)
        study = tuning.tune(("constant-velocity", "acc.csv"), filter="kf")

    Q's variances and R are searched from 1e-10 to 1e4 times the rule of thumb, on logarithmic scales, beginning
    from 1e-5 to 1e2 (R: 1e-2 to 1e3) and ten times beyond the best trial; given values lie inside, and the report
    flags a parameter at an end of its range. Besides sampled trials the study tries the baselines (given, rule of
    thumb, scaled default, noise estimation) and the maximum-likelihood values. At the end the best trials are
    compared with the baselines on 100 validation seeds. If none is significantly better, the best baseline is
    chosen, and the report names the runs in which what was given fails.

    RMSE alone barely determines Q and R: only their ratio affects the estimate. The study therefore keeps the mean
    NIS in a band, unless that is switched off, as long as it costs at most 5 % of the score. With true states
    it chooses the trial with the best log score among those within 5 % of the least error. If no trial is in the
    band, the report and the file say so, and the command's exit code is 3.

    --method also selects another sampler, gradients, or a published method, which runs alone: samplers end after
    --trials trials, the others by their own criterion. With a right model and true states use noise-estimation.
    With true states use log-score if the covariance matters, mse if only the estimate does. Without true states
    use likelihood, or als for a linear model on long runs, which accepts --full-q and --full-r. For an ensemble
    use the default, or desroziers without true states. With true states and a wrong model, or a dead band, add
    --full-q (and --full-r) to mse or log-score. `thruster methods` lists all methods.

    With --log the study uses recorded runs, cut into blocks of which every third is held out. It minimises the
    negative log-likelihood of the innovations, unless the logs contain the true states.

    Example: thruster tune --filter ekf --scenario mismatch --scenario outliers --trials 100

    Example: thruster tune --filter ekf --log run1.csv --log run2.csv --trials 100

    Example: thruster tune --filter kf --log acc.csv --model constant-velocity

    Example: thruster tune --filter ekf --method log-score --scenario mismatch

    Example: thruster tune --filter auto --budget 2 --scenario published_noise --trials 100

    Example: thruster tune --filter ekf --augment voltage_gain --scenario mismatch

    Args:
        problem: name of a problem; several for their mean, or the worst with `worst`; mismatch by default. In
            Python also a `Problem`, `tuning.find_problem(...)`, `tuning.read_logs(...)`, a pair (model, data) of a
            model, its name, or a thruster's preset, and recorded runs, or a list.
        filter: name of a filter, as `thruster filters` lists them, or auto: the best of all within `budget`. In
            Python also "module:object" for an estimator of your own, which can be used, but not saved.
        space: what is searched.
        budget: time limit of a step of the filter on one core; of auto by default 2.5 n^2 for n states.
        trials: total number of finished trials of the study.
        objective: what to minimise, two for a Pareto front; by default the score, or without true states the
            negative log-likelihood.
        worst: minimise the worst of several problems instead of their mean.
        consistent: whether to keep the mean NIS between 0.8 and 1.25 of its expected value.
        prune: whether to end trials that are significantly worse than the best on the same seeds.
        method: a study by a sampler (tpe, gp, cma-es, nsga-ii, random, grid), gradient for Kalman filters, or a
            published method; `thruster methods` lists them and when to use which.
        workers: processes on this host that share the study; several need a storage.
        storage: journal file for one host; for several, a database (docs/workers.md). In Python by default none:
            the study ends with the process.
        name: name of the study; by default from the options above.
        out: tuned file; out/STUDY.json by default. In Python none by default, and True for that one. A filter of
            your own has none, as such a file names no code: store its parameters yourself.
        seed: seed of all randomness; the same seed gives the same results.
        progress: whether to show progress; by default only in terminals and notebooks.
        **reading: refused; options of logs belong to `tuning.read_logs`.

    Returns:
        `Study`: `filter`, `choice`, `held_out`, `save(path)`, `to_frame()`, `plot_history()`, `plot_errors()`.

    Raises:
        ValueError: states the rule and the value.
        KeyboardInterrupt: after Ctrl-C before any trial is complete, or during the held-out evaluation.
    """
    for name in reading:
        if name not in signature(read_logs).parameters:
            raise TypeError(f"tune() got an unexpected keyword argument {name!r}")
        raise ValueError(
            f"{name} must be given to tuning.read_logs, whose runs tune takes, not to tune: {OF_NUMBERS}"
        )
    if not isinstance(filter, str):
        raise ValueError(
            f"filter must be a name or 'module:object', by which trials keep it, but got {short_repr(filter)}"
        )
    if out is True and is_foreign(filter):
        out = None  # what a tuned file names is no code
    if out is not None:
        check_keepable(filter)
    sampler, problems = sampler_of(method), problems_of(problem)
    asked = [objective] if isinstance(objective, str) else None if objective is None else list(objective)
    plan = Plan(
        filter,
        problems,
        seed,
        tuple(asked or ["score" if problems[0].scale is not None else "likelihood"]),
        consistent=consistent,
        sampler=sampler,
        hold_r=space.hold_r,
        prune=prune,
        budget=budget,
        full_q=space.full_q,
        full_r=space.full_r,
        where=(space.where,) if isinstance(space.where, str) else tuple(space.where),
        worst=worst,
        forget=space.forget,
    )
    plan, aim = with_budget(plan), aim_of(asked)
    study = name or name_of(plan, method, aim)
    file = None if out in (None, False) else Path("out") / f"{study}.json" if out is True else Path(str(out))
    journal, console = None if storage is None else storage_text(storage), console_for(progress)
    return run_tuning(plan, trials, console, journal, study, file, method=method, aim=aim, workers=workers)


ANSWER = "answer of the method"  # attribute of a study
OLD_ANSWER, OLD_NAME = "answer of the way", "-way-"  # the same, and a part of its name, in journals until 2026


def check_method(plan: Plan, name: str, workers: int) -> None:
    """Raise ValueError for an unknown method, or a plan that it does not support."""
    method, word = find_method(name), f"method={name!r} (--method)"
    if method.is_study and name != GRADIENT_METHOD:
        return
    if plan.worst:
        raise ValueError(f"{word} must minimise the mean over problems, but got worst (--worst)")
    if name == GRADIENT_METHOD:
        check_gradient(plan.filter, "a filter whose likelihood has a gradient")
        if plan.budget is not None:
            raise ValueError(f"{word} must come without a budget, but got budget (--budget)")
        return
    if plan.budget is not None or plan.filter == AUTO:
        raise ValueError(f"{word} must have one filter, and no budget of microseconds per step")
    if len(plan.objectives) > 1:
        raise ValueError(f"{word} must have one objective, but got {list(plan.objectives)}")
    if workers > 1:
        raise ValueError(f"workers (--workers) must be 1 with {word}, but got {workers}")


def run_alone(
    study: optuna.Study, plan: Plan, data: Sequence[Data], trials: int, on_trial: OnTrial, *, name: str
) -> bool:
    """Run a method to its end, or one that samples trials for as many as a study has: `run` of `run_study`.

    Returns:
        Whether Ctrl-C ended it; its results so far are kept.

    Raises:
        ValueError: if the plan lacks what the method needs.
    """
    if _answer_in(study) is not None:
        return False
    options = plan.options if filter_type(plan.filter).has_covariance else {}
    with stop_on_interrupt() as interrupted:
        arguments: dict[str, Any] = {"options": options, "objective": plan.objectives[0]}
        passes = sum(len(runs.seeds) for runs in data)
        arguments["budget"] = Budget(trials * passes) if find_method(name).by_trials else Budget()
        task = Task(plan.filter, plan.scenarios, data, start=_start(plan, name), given=_given(plan), **arguments)
        task.seed, task.stop = plan.seed, interrupted
        find_method(name).run(name, task)
        stopped = interrupted()
    space = plan.space()
    path = task.answers[1:] if task.refused is None else task.answers[1:-1]
    for choice in _some([step.choice for step in path], trials - 1):
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

    From a start far off these often end elsewhere, and from there they do not (docs/appendix/methods.md).
    """
    if name not in OF_STATES or not plan.full_q:
        return None
    estimated = noise_estimated(plan.filter, plan.scenarios[0], plan.seed)
    if estimated is None or not plan.hold_r and (plan.full_r or np.ndim(estimated.model[R]) < 2):
        return estimated
    rule = untuned_choice(plan.filter, plan.scenarios[0]).model[R]
    r = rule if plan.hold_r else tuple(np.diag(np.asarray(estimated.model[R])).tolist())
    return estimated._replace(model={**estimated.model, R: r})


def _given(plan: Plan) -> Choice | None:
    """The model's own numbers; None if there are none, or if they are the plant's, which no study knows."""
    problem = plan.scenarios[0]
    model_choice, true = given_choice(plan.filter, problem), oracle_choice(plan.filter, problem)
    if model_choice is None or (true is not None and same_filter(model_choice, true)):
        return None
    if plan.hold_r and R in model_choice.model:
        model_choice = model_choice._replace(
            model={**model_choice.model, R: untuned_choice(plan.filter, problem).model[R]}
        )
    return model_choice


def _answer_in(study: optuna.Study) -> dict[str, Any] | None:
    """The answer of a method that is stored in a study; None before it is there."""
    attributes = study.user_attrs
    answer: dict[str, Any] | None = attributes.get(ANSWER, attributes.get(OLD_ANSWER))
    return answer


def answered(study: optuna.Study, result: StudyResult, plan: Plan, name: str) -> tuple[StudyResult, MethodAnswer]:
    """The result of a study with the answer of a method instead of the best trial, and the method's cost."""
    answer = _answer_in(study)
    assert answer is not None
    stored, refused = answer["choice"], answer.get("refused")
    choice = plan.forgetting(Choice(stored["name"], _tuples(stored["model"]), _tuples(stored["numbers"])))
    choice = plan.forgetting(choice, exact=True)
    value = measured(choice, plan, plan.training_data()).value
    nothing: dict[str, Any] = dict.fromkeys(("consistent", "validation", "sized", "free_value", "band_value"))
    alone = result._replace(choice=choice, best_value=value, nis=(), sizes=[], **nothing)
    cost = answer["runs"], answer["seconds"]
    return alone, MethodAnswer(name, choice, *cost, refused and Refused(*refused))


def _some(choices: Sequence[Choice], count: int) -> list[Choice]:
    """At most so many of some choices, the last one among them, without two that are the same."""
    if len(choices) <= count or count < 1:
        return list(choices) if count >= 1 else []
    indices = sorted({round((i + 1) * len(choices) / count) - 1 for i in range(count)})
    return [choices[i] for i in indices]


def _tuples(content: Any) -> Any:
    """What JSON kept, with tuples in place of lists, as choices have it."""
    if isinstance(content, dict):
        return {key: _tuples(value) for key, value in content.items()}
    return tuple(map(_tuples, content)) if isinstance(content, list | tuple) else content


MOST_TRIALS = 1_000_000
MOST_WORKERS = 1000
DIGITS = 6  # of a digest in the name of a study
DEFAULT_BUDGET = 2.5  # us/step of one core over the square of the number of states
FEWEST_A_TYPE = 5  # trials of a study among filter types, over the number of types
OPTIMUM = "optimum of the {}"  # the gradient's answer among those that meet, by its objective
COST = "cost"  # the objective that needs no budget


def run_tuning(
    plan: Plan,
    trials: int,
    console: Console,
    storage: str | None = None,
    name: str | None = None,
    out: Path | None = None,
    *,
    method: str | None = None,
    aim: str = LIKELIHOOD,
    workers: int = 1,
) -> Study:
    """Run or resume a study with a progress bar, evaluate its choice and, if requested, write the tuned file.

    Args:
        plan: of the study.
        trials: total number of finished trials.
        console: where progress is shown.
        storage: journal file or URL; None for a study that ends with the process.
        name: of the study; from the plan if None.
        out: the tuned file; none is written if None.
        method: determines the choice, one of `tuning.methods.task.METHODS`; None for a study by the plan's
            sampler.
        aim: the objective of the method "gradient", as of `aim_of`.
        workers: processes that share the study.

    Raises:
        ValueError: states the rule and the value.
        KeyboardInterrupt: after Ctrl-C before any trial is complete, or during the held-out evaluation.
    """
    trials, workers = at_least("trials", trials, 1, MOST_TRIALS), at_least("workers", workers, 1, MOST_WORKERS)
    method = plan.sampler if method is None else method
    check_method(plan, method, workers)
    alone = not find_method(method).is_study
    if workers > 1 and storage is None:
        raise ValueError(
            f"workers must be 1 without a storage that they share, such as "
            f"storage='studies.journal', but got {workers}"
        )
    if workers > 1 and str(storage).startswith("sqlite"):
        warnings.warn(
            f"SQLite locks the whole database for each write, so {workers} workers wait for each other: a journal "
            "file is faster on one host, and several hosts need a server (docs/workers.md)",
            stacklevel=2,
        )
    name = name or name_of(plan, method, aim)
    if not isinstance(name, str) or "/" in name:
        raise ValueError(f"study must be a name without slashes, but got {short_repr(name)}")
    if out is not None:
        check_target(out)
    with quiet_optuna():
        plan = checked(plan)  # before there is a journal
        warn_of_few_trials(plan, trials)
        _draw_first(plan, console)
        opened = None if storage is None else open_storage(storage)
        if alone and opened is not None:
            name = _stored_name(opened, name, method)
        study = open_study(name, plan, opened)
        already = finished_trials(study)
        before = [trial for trial in study.get_trials(deepcopy=False) if trial.state in FINISHED]
        if already:
            console.print(f"study {name!r} continues after {already} finished trials")
        with trial_bar(plan, names_of(plan), trials, before, console) as (advance, show_kinds):
            run = partial(run_trials, on_choice=lambda choice: show_kinds([choice.name]))
            if storage is not None and workers > 1:
                run = partial(run_in_workers, storage=storage, workers=workers)
            if alone:
                run = partial(run_alone, name=method)
            result = run_study(study, plan, trials, advance, run)
    gradient = rival = answer = None
    if alone:
        result, answer = answered(study, result, plan, method)
    if method == GRADIENT_METHOD:
        with working(f"following the gradient of the {aim}", console):
            data, options = plan.training_data(), plan.options
            gradient = tune_by_gradient(plan.filter, plan.scenarios, data, objective=aim, options=options)
        rival = evaluate_held_out(result.choice, plan.scenarios[0], plan.seed)
        with working(f"comparing it with the baselines on validation {plan.scenarios[0].seed_word}", console):
            result = answered_by(result, plan, OPTIMUM.format(aim), plan.forgetting(gradient.choice))
    try:
        with working(f"proving the choice on held-out {plan.scenarios[0].seed_word}", console):
            comparisons = tuple(
                evaluate_held_out(result.choice, scenario, plan.seed) for scenario in plan.scenarios
            )
    except KeyboardInterrupt:
        if storage is not None:
            console.print(
                f"study {name!r} keeps its trials: the same command continues with the held-out evaluation"
            )
        raise
    tuned = Study(name, plan, result, comparisons, out, gradient, rival, answer=answer)
    if out is not None:
        tuned.write(out)
    if gradient is not None:
        return tuned
    known = identify(result.choice, plan.scenarios, plan.training_data(), plan.space(), plan.where)
    return replace(tuned, known=known)


def with_budget(plan: Plan) -> Plan:
    """The plan; one of filter "auto" without a budget has the default, with a warning: 2.5 n^2 us/step, n states.

    Of two states an EKF takes a hundredth of it, an EnKF of 30 members a tenth, 1000 particles twice as much.
    """
    if plan.filter != AUTO or plan.budget is not None or COST in plan.objectives or not plan.scenarios:
        return plan
    states = len(plan.scenarios[0].quantities.states)
    budget = DEFAULT_BUDGET * states**2
    warnings.warn(
        f"filter 'auto' got no budget (--budget): a step may take {budget:g} microseconds of one core, the "
        f"default of {states} states",
        stacklevel=3,
    )
    return plan._replace(budget=budget)


def warn_of_few_trials(plan: Plan, trials: int) -> None:
    """Warn of a study among filter types with fewer than five trials a type: the race then hardly begins."""
    types = len(plan.filter_types)
    if types > 1 and trials < FEWEST_A_TYPE * types:
        warnings.warn(
            f"{trials} trials are fewer than {FEWEST_A_TYPE} for each of {types} filter types: --trials "
            f"{FEWEST_A_TYPE * types} would be enough",
            stacklevel=3,
        )


def _draw_first(plan: Plan, console: Console) -> None:
    """Draw the held-out data of users' problems, which are kept: what is wrong is said before the search."""
    for problem in plan.scenarios:
        if isinstance(problem, AssumedProblem):
            with working(f"drawing the held-out {problem.seed_word}", console):
                problem.data(problem.held_out_seeds(plan.seed, HELD_OUT_SEEDS))


def aim_of(asked: Sequence[str] | None) -> str:
    """The objective of the method "gradient": the requested one if it has a gradient, or the likelihood."""
    return asked[0] if asked and asked[0] in OF_STATES else LIKELIHOOD


def sampler_of(method: str) -> str:
    """The sampler of a plan: that of a study; the default, which is not used, of a method that runs alone."""
    return find_method(method).sampler or DEFAULT


def name_of(plan: Plan, method: str = DEFAULT, aim: str = LIKELIHOOD) -> str:
    """A name for a study of a plan, with everything that differs from the default.

    Of a user's problem or logs it has the beginning of their digest: another model makes another study.
    """
    parts = [
        re.sub(r"[^\w.+-]+", "-", label_of(plan.filter)),
        "+".join(map(_name_and_digest, plan.scenarios)),
        f"seed{plan.seed}",
    ]
    parts += ["+".join(plan.objectives)] * (plan.objectives != ("score",))
    parts += ["hold-r"] * plan.hold_r + ["full-q"] * plan.full_q
    parts += ["full-r"] * plan.full_r
    parts += [re.sub(r"[^\w.+-]+", "", setting.replace("=", "-")) for setting in plan.where]
    parts += [] if plan.budget is None else [f"budget{plan.budget:g}"]
    parts += [] if plan.forget is None else [f"forget{plan.forget:g}"]
    parts += ["any-nis"] * (not plan.consistent) + [plan.sampler] * (plan.sampler != "tpe")
    if method == GRADIENT_METHOD:
        parts.append("gradient-score" if aim == SCORE else "gradient")
    elif not find_method(method).is_study:
        parts += ["method", method]
    return "-".join(parts)


def _stored_name(storage: optuna.storages.BaseStorage, name: str, method: str) -> str:
    """The name of the study of a method that runs alone: the former one if only that is in the storage."""
    base = name.removesuffix(f"-method-{method}")
    former = name if base == name else base + OLD_NAME + method.removesuffix(ONLY)
    names = optuna.get_all_study_names(storage)
    return former if former in names and name not in names else name


def _name_and_digest(problem: Problem) -> str:
    name = short_name(problem)
    return name if within(problem).name in built_in() else f"{name}-{problem.digest[:DIGITS]}"


def names_of(plan: Plan) -> str:
    """Names of a plan's scenarios as used in names of studies and files."""
    return ", ".join(map(short_name, plan.scenarios))


def short_name(problem: Problem) -> str:
    """A problem's name as used in names of studies and files."""
    return file_name(problem.name)


def file_name(name: str) -> str:
    """A problem's name without folders and special characters: "nominal-mine" of "nominal (presets/mine.toml)"."""
    paths = [Path(part.removesuffix(")")) for part in name.split(" (")]
    text = "-".join(path.stem if path.suffix == ".toml" else path.name for path in paths)
    return re.sub(r"[^\w.+-]+", "-", text).strip("-")
