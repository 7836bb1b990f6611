"""`tuning.tune`: find a filter's Q, R and other parameters, and evaluate them on held-out seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from thruster_env.core.checks import short_repr
from tuning.api.problems import problems_of
from tuning.api.progress import console_for
from tuning.api.run import aim_of, run_tuning, with_budget
from tuning.api.study import Study
from tuning.problems.augmented import augmented, unknowns_of
from tuning.search.plan import Plan
from tuning.search.storage import storage_text


def tune(
    problem: Any,
    filter: str = "ekf",
    *,
    trials: int = 50,
    seed: int = 0,
    objective: str | Sequence[str] | None = None,
    consistent: bool = True,
    worst: bool = False,
    hold_r: bool = False,
    full_q: bool = False,
    full_r: bool = False,
    where: Sequence[str] = (),
    forget: float | None = None,
    augment: Sequence[str] | Mapping[str, Any] = (),
    budget: float | None = None,
    sampler: str = "tpe",
    prune: bool = True,
    method: str = "optuna",
    way: str | None = None,
    workers: int = 1,
    storage: str | Path | None = None,
    name: str | None = None,
    progress: bool | None = None,
    preset: str | Path | None = None,
    sensors: Sequence[str] | None = None,
    columns: Any = None,
    clock_offset: Any = None,
    dt: float | None = None,
    grid: bool = True,
    stamps: str | None = None,
    held_out: Any = None,
    blocks: int | None = None,
    lead: int | None = None,
    hold_gaps: bool | None = None,
    start: str | None = None,
) -> Study:
    """Find the Q, R and ensemble size that give a filter's best estimate, and evaluate it on held-out seeds.

    The score is the mean over states of RMSE over its bound, on 32 training seeds that every trial shares; for
    recorded runs without true states it is the negative log-likelihood of the innovations. The first trial is the
    rule of thumb. The mean NIS is kept in a band, because RMSE barely determines Q and R: only their ratio affects
    the estimate. Ctrl-C keeps all finished trials: the study then consists of these and is marked `interrupted`.

        study = tuning.tune("mismatch", filter="enkf", trials=50)
        study.save("tuned.json")
        study.plot_errors()

        study = tuning.tune((model, ["run1.csv", "run2.csv"]), trials=100)

    Args:
        problem: a name, such as "mismatch" or "auv:motion", a .toml file, or "module:object"; a
            `Problem`; a pair (model, data) of a model, or a thruster's preset, and recorded runs; or a list of
            problems, for the mean of their objectives or the `worst`. Recorded runs are paths,
            pandas tables, mappings from headers to arrays, or `Log`s.
        filter: name of a filter; "auto" for the best of all within the budget; or "module:object" for an estimator
            of your own, which can be used and evaluated, but not saved.
        trials: total number of finished trials of the study.
        seed: of all randomness; the same seed gives the same results.
        objective: the quantity to minimise, or two for a Pareto front, as `thruster tune --objective` lists them;
            by default the score, or without truth the negative log-likelihood.
        consistent: whether the mean NIS is kept between 0.8 and 1.25 times its expected value; the objective
            "log-score" needs no such band.
        worst: of several problems, minimise the objective of the worst one.
        hold_r: keep R at the data sheet's value, tune only Q.
        full_q: tune the correlations of Q, too.
        full_r: tune the correlations of R, too.
        where: relations that parameters must obey, such as "Q22 = 4 Q11", "Q33 = Q11", "R = 0.01"
            (not tuned), "Q11 = 1e-6..1e-2" (its range).
        forget: the longest time constant of the filter's gain that is allowed [s]; a smaller Q is raised to it.
        augment: constants of the model, such as "voltage_gain", that the filter also estimates, as further states
            whose random walks are tuned with Q; by name with an `Unknown`, or (std, walk).
        budget: time limit of a step of the filter [microseconds of one core]; for "auto" by default 2.5 times the
            square of the number of states.
        sampler: Optuna's sampler: "tpe", "random", "cma-es", ...
        prune: end a trial that is significantly worse than the best on the same seeds.
        method: "optuna"; or "gradient", for Kalman filters except kf-steady, gsf, imm, mmae, mhe, fuzzy: maximum
            likelihood, or the best "score", "mse" or "log-score" if that is the objective.
        way: another way of tuning instead of a study, such as "em", as `thruster ways` lists them: a sampler ends
            after `trials` trials, the others by their own criterion.
        workers: processes on this host that share the study; several need a storage.
        storage: journal file or URL of a database that saves the study, so that the same call continues it; by
            default it ends with the process.
        name: of the study; by default from the arguments above.
        progress: whether to show progress; by default only in terminals and notebooks.
        preset: the problem of another thruster, by name or file.
        sensors: for recorded runs of a thruster, the channels that the filter sees.
        columns: for recorded runs, headers by quantity.
        clock_offset: for recorded runs, seconds by quantity that a channel's clock is ahead.
        dt: for recorded runs, the sample time [s].
        grid: for recorded runs, whether they are put on a grid; else on their own stamps, as in `estimate`.
        stamps: for bags, "header" or "receipt", as in `estimate`.
        held_out: recorded runs used only for the held-out evaluation; by default every third.
        blocks: number of blocks per recorded run.
        lead: rows at the beginning of a block that are not scored.
        hold_gaps: hold the last input over gaps of a log; by default runs are split there.
        start: initial state of blocks of logs: "prior", or "measurement", from their first measurement.

    Returns:
        `Study`: `filter`, `choice`, `held_out`, `save(path)`, `to_frame()`, `plot_history()`, `plot_errors()`.

    Raises:
        ValueError: states the rule and the value.
        KeyboardInterrupt: after Ctrl-C before any trial is complete, or during the held-out evaluation.
    """
    asked = [objective] if isinstance(objective, str) else objective
    aim = aim_of(method, None if asked is None else list(asked))
    if not isinstance(filter, str):
        raise ValueError(
            f"filter must be a name or 'module:object', by which trials keep it, but got {short_repr(filter)}"
        )
    of_logs: dict[str, Any] = {"sensors": sensors, "columns": columns, "clock_offset": clock_offset, "dt": dt}
    of_logs |= {"grid": None if grid else False, "stamps": stamps}
    of_logs |= {"held_out": held_out, "blocks": blocks, "lead": lead, "hold_gaps": hold_gaps, "start": start}
    unknown = unknowns_of(augment)
    problems = tuple(augmented(one, unknown) for one in problems_of(problem, preset, **of_logs))
    if objective is None:
        objective = "score" if problems[0].scale is not None else "likelihood"
    plan = Plan(
        filter,
        problems,
        seed,
        (objective,) if isinstance(objective, str) else tuple(objective),
        consistent=consistent,
        sampler=sampler,
        hold_r=hold_r,
        prune=prune,
        budget=budget,
        full_q=full_q,
        full_r=full_r,
        where=(where,) if isinstance(where, str) else tuple(where),
        worst=worst,
        forget=forget,
    )
    plan = with_budget(plan)
    place = None if storage is None else storage_text(storage)
    console = console_for(progress)
    return Study(run_tuning(plan, trials, console, place, name, by_gradient=aim, way=way, workers=workers))
