"""The picture of docs/tuning.md, and its tables on what tuning finds and gains."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import optuna

from docs.scripts import about, by_name, log_ticks, subplots
from filters.augmented import Unknown, augmented_model
from filters.filter import Filter
from filters.registry import make_filter
from thruster_env.core.files import BLUE, DARK, RUST, save_figure
from thruster_env.core.sources import written_out
from thruster_env.core.text_tables import markdown_table
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.thruster.dynamics import Constants
from tuning.evaluation.baselines import ORACLE, RULE, SCALED, scaled_default
from tuning.evaluation.evaluate import Evaluation, evaluate, score_ratio
from tuning.evaluation.held_out import evaluate_held_out
from tuning.experiments.benchmark import run_in_memory
from tuning.plants.thruster import Scenario, find_scenario
from tuning.search.plan import HELD_OUT_SEEDS, NIS_BAND, Plan, nis_violation, penalised
from tuning.search.space import Choice, distributions, suggest, trial_parameters
from tuning.search.trials import make_sampler

SEED, TRIALS = 0, 100
BASELINES = SCALED, RULE, ORACLE
COLUMNS = ["scenario", "filter", *(f"over {name}" for name in BASELINES), "N", "NEES", "NIS", "price of NIS"]
FILTERS = ("kf", "ekf", "enkf")
EARNING = ("mismatch", "ambient", "deadband", "outliers")  # where the true Q and R are not the best ones
FACTORS = np.geomspace(1e-3, 1e3, 31)


def ridge(path: Path) -> Path:
    """Score and mean NIS of an EKF over common factors on Q and on R."""
    scenario = find_scenario("nominal")
    data = Plan("ekf", (scenario,), SEED).training_data()[0]

    def scaled(q: float, r: float) -> tuple[float, float]:
        q_scaled = tuple(q * v for v in scenario.process_noise_cov)
        noise = {"process_noise_cov": q_scaled, "measurement_noise_cov": r * scenario.measurement_noise_cov}
        evaluation = evaluate(Choice("ekf", noise, {}).filter(scenario), data, scenario.scale)
        return evaluation.score.value, evaluation.nis.value

    scores, ratios = np.array([[scaled(q, r) for q in FACTORS] for r in FACTORS]).transpose(2, 0, 1)
    figure, (plane, line) = subplots((9.6, 4.0), 1, 2, width_ratios=(3, 2))
    for axis in (plane.xaxis, plane.yaxis, line.xaxis, line.yaxis):
        log_ticks(axis, (1e-3, 1e-2, 0.1, 1, 10, 100, 1000))
    lines = plane.contour(FACTORS, FACTORS, scores, [1.005, 1.02, 1.1, 1.4, 2.0], colors=BLUE)
    plane.clabel(lines, fmt="%g", fontsize=8)
    plane.contourf(FACTORS, FACTORS, ratios, NIS_BAND, colors=RUST, alpha=0.3)
    plane.plot(1, 1, "o", color=DARK, label="the plant's own Q and R")
    plane.fill_between([], [], color=RUST, alpha=0.3, label="mean NIS between 0.8 and 1.25")
    plane.plot([], [], color=BLUE, label="score over that of the bound")
    plane.set(xlabel="factor on Q [-]", ylabel="factor on R [-]")
    both = np.diag(scores), np.diag(ratios)
    for values, colour, dashes, label in zip(both, (BLUE, RUST), ("-", "--"), ("score", "mean NIS"), strict=True):
        line.plot(FACTORS, values, color=colour, linestyle=dashes, label=label)
    line.set(xlabel="one factor on both, Q and R [-]", ylabel="score, mean NIS [-]")
    plane.legend(loc="upper left", fontsize=8)
    line.legend(frameon=False)
    return save_figure(figure, path)


def earned(scenarios: Sequence[str] = EARNING, trials: int = TRIALS) -> str:
    """What a study gains over the scaled default, the rule of thumb and the oracle."""
    rows = []
    for name in scenarios:
        scenario = find_scenario(name)
        for kind in FILTERS:
            result = run_in_memory(Plan(kind, (scenario,), SEED), trials)
            comparison = evaluate_held_out(result.choice, scenario, SEED)
            ratios = [about(comparison.ratios[by]) if by in comparison.ratios else "none" for by in BASELINES]
            size = f"{result.choice.numbers['ensemble_size']}" if result.sizes else ""
            met = result.validation  # whose price decides between a mean NIS in its band and the log score
            price = "" if met is None or met.price is None else f"{100 * met.price:.1f} %"
            title = f"`{name}`" if kind == FILTERS[0] else ""
            rows.append([title, f"`{kind}`", *ratios, size, *_consistency(comparison.tuned), price])
    return markdown_table(COLUMNS, rows)


def _consistency(evaluation: Evaluation) -> list[str]:
    nees = evaluation.nees.value
    return [f"{nees:.3g}" if nees < 1000 else "> 1000", f"{evaluation.nis.value:.2f}"]


SCENARIO = "mismatch"
LIFT = "lift_factor"  # on the lift coefficient, which enters several constants of the model
SLOPES = tuple(name for name in Constants._fields if name.startswith(("thrust_", "torque_")))
LiftedConstants = namedtuple("LiftedConstants", (*Constants._fields, LIFT, *(f"slope_{name}" for name in SLOPES)))
UNKNOWNS = {  # what a further state stands for, by how the table calls it
    "the lift coefficient": (LIFT,),
    "the voltage gain K2": ("voltage_gain",),
    "the load gain K_h": ("load_gain",),
    "lift and K2": (LIFT, "voltage_gain"),
    "lift, K2 and K1": (LIFT, "voltage_gain", "motor_damping"),
}
SPREADS, WALKS = (0.01, 0.5), (1e-6, 0.1)  # of the prior and of a step's change, as parts of the constant
START = 0.15, 1e-3
BOUGHT = ["what is tuned", "over the scaled default", "omega_m [rad/s]", "U_a [m/s]", "NEES", "NIS"]
RIGHT = "`ekf` with the right parameters, scaled default"
OUTSIDE = 10.0  # what a mean NIS outside its band costs, by its logarithm


def plans() -> dict[str, Plan]:
    """Studies of the package, by how the table calls them."""
    scenarios = (find_scenario(SCENARIO),)
    kinds = {"`ekf`, Q and R": "ekf", "`ekf`, full Q": "ekf", "`enkf`, inflation and relaxation, too": "enkf"}
    kinds |= {f"`{kind}`": kind for kind in ("sage-husa", "vb", "ekf-robust")}
    return {name: Plan(kind, scenarios, SEED, full_q="full" in name) for name, kind in kinds.items()}


def lifted(scenario: Scenario, **changes) -> StateSpaceModel:
    """The model of a scenario with a factor on the lift among its constants; forces are linear in it."""
    factors = dict(scenario.parameter_factors)
    more = factors | {"lift_coefficient": 2.0 * factors.get("lift_coefficient", 1.0)}
    model, double = (scenario.model(**{"parameter_factors": f, **changes}) for f in (factors, more))
    slopes = [getattr(double.constants, name) - getattr(model.constants, name) for name in SLOPES]
    values = [
        f"c.{name} + (c.{LIFT} - 1.0) * c.slope_{name}" if name in SLOPES else f"c.{name}"
        for name in Constants._fields
    ]
    fill = written_out("fill", "c", f"Constants({', '.join(values)})", Constants=Constants)
    functions = {
        name: written_out(name, f"{arguments}, c", f"plain({arguments}, fill(c))", fill=fill, plain=plain)
        for name, arguments, plain in (
            ("transition", "x, u", model.transition),
            ("observe", "x", model.observe),
            ("transition_jacobian", "x, u", model.transition_jacobian),
            ("observe_jacobian", "x", model.observe_jacobian),
        )
    }
    return model.replace(**functions, constants=LiftedConstants(*model.constants, 1.0, *slopes))


def augmented(choice: Choice, scenario: Scenario, beliefs: Mapping[str, tuple[float, float]]) -> Filter:
    """An EKF of a choice's Q and R that also estimates constants; beliefs are parts of them, (prior, step)."""
    model = lifted(scenario, **choice.model)
    unknown = {
        name: Unknown(*(part * getattr(model.constants, name) for part in parts))
        for name, parts in beliefs.items()
    }
    return make_filter("ekf", augmented_model(model, unknown))


def tuned_augmented(scenario: Scenario, names: Sequence[str], starts: Sequence[Choice], trials: int) -> Filter:
    """An EKF with constants as states: a study of Q, R, and of the prior and the walk of each constant.

    Its first trials have the Q and R of `starts`. The value is the score, with a penalty where the mean NIS is
    outside its band.
    """
    plan = Plan("ekf", (scenario,), SEED)
    data = plan.training_data()[0]
    space = distributions("ekf", scenario)

    def filter_of(trial) -> Filter:
        beliefs = {
            name: (
                trial.suggest_float(f"{name} prior", *SPREADS, log=True),
                trial.suggest_float(f"{name} walk", *WALKS, log=True),
            )
            for name in names
        }
        return augmented(suggest(trial, "ekf", scenario, space), scenario, beliefs)

    def value(trial) -> float:
        evaluation = evaluate(filter_of(trial), data, scenario.scale)
        return penalised(evaluation.score.value, evaluation) + OUTSIDE * max(0.0, nis_violation(evaluation))

    study = optuna.create_study(sampler=make_sampler("tpe", SEED, 0, {}, first=plan.first_ranges()))
    first = dict(zip(("prior", "walk"), START, strict=True))
    beliefs = {f"{name} {part}": number for name in names for part, number in first.items()}
    for start in starts:
        study.enqueue_trial({**trial_parameters(start, space), **beliefs})
    study.optimize(value, n_trials=trials)
    return filter_of(optuna.trial.FixedTrial(study.best_params))


def bought(trials: int = TRIALS, rows: Sequence[str] | None = None, seeds: int = HELD_OUT_SEEDS) -> str:
    """The gain of each method of tuning on held-out seeds, all against the scaled default of the EKF.

    Args:
        trials: of each study; twice as many where constants are states.
        rows: of the table; all by default.
        seeds: number of held-out ones.
    """
    scenario = find_scenario(SCENARIO)
    held_out = scenario.data(scenario.held_out_seeds(SEED, seeds))
    default = scaled_default("ekf", scenario, SEED).choice
    known = scenario.replace(parameter_factors={})
    filters: dict[str, Callable[[], Filter]] = {
        name: lambda plan=plan: run_in_memory(plan, trials).choice.filter(scenario)
        for name, plan in plans().items()
    }
    starts = run_in_memory(plans()["`ekf`, Q and R"], trials).choice, default
    filters |= {
        f"`ekf` + {name}": lambda names=names: tuned_augmented(scenario, names, starts, 2 * trials)
        for name, names in UNKNOWNS.items()
    }
    filters[RIGHT] = lambda: scaled_default("ekf", known, SEED).choice.filter(known)
    base = evaluate(default.filter(scenario), held_out, scenario.scale)
    lines = [_line("`ekf`, scaled default", base, base)]
    for name in rows if rows is not None else filters:
        lines.append(_line(name, evaluate(filters[name](), held_out, scenario.scale), base))
    return markdown_table(BOUGHT, lines)


def _line(name: str, evaluation: Evaluation, base: Evaluation) -> list[str]:
    ratio, (speed, flow) = score_ratio(evaluation, base), evaluation.rmse
    return [name, about(ratio), f"{speed.value:.3f}", f"{flow.value:.4f}", *_consistency(evaluation)]


FIGURES = {"tuning_ridge.png": ridge}
TABLES = by_name(earned, bought)
