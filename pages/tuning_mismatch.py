"""Make the table of docs/tuning.md on what tuning can buy where the model is wrong.

    python -m pages.tuning_mismatch [FOLDER]

If there is a tuning.md in FOLDER, docs/ by default, its table is written anew, which takes two minutes.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence

import optuna

from filters.augmented import Unknown, augmented_model
from filters.filter import Filter
from filters.registry import make_filter
from pages.page import make_page
from thruster_env.core.compiled import inlined
from thruster_env.core.sources import written_out
from thruster_env.core.text_tables import markdown_table
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.thruster.dynamics import Constants
from tuning.evaluation.baselines import scaled_default
from tuning.evaluation.evaluate import Evaluation, evaluate, score_ratio
from tuning.search.objectives import nis_violation, penalised
from tuning.search.plan import HELD_OUT_SEEDS, Plan
from tuning.search.samplers import make_sampler
from tuning.search.space import Choice, distributions, suggest, trial_parameters
from tuning.search.study import open_study, quiet_optuna, run_study
from tuning.thruster.scenario import Scenario, find_scenario

SCENARIO, SEED, TRIALS = "mismatch", 0, 100
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
COLUMNS = ["what is tuned", "over the scaled default", "omega_m [rad/s]", "U_a [m/s]", "NEES", "NIS"]
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
        name: written_out(name, f"{arguments}, c", f"plain({arguments}, fill(c))", fill=fill, plain=inlined(plain))
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
    """What each way of tuning buys on held-out seeds, all against the scaled default of the EKF.

    Args:
        trials: of each study; twice as many where constants are states.
        rows: of the table; all by default.
        seeds: number of held-out ones.
    """
    quiet_optuna()
    scenario = find_scenario(SCENARIO)
    held_out = scenario.data(scenario.held_out_seeds(SEED, seeds))
    default = scaled_default("ekf", scenario, SEED).choice
    known = scenario.replace(parameter_factors={})
    filters: dict[str, Callable[[], Filter]] = {
        name: lambda plan=plan: _studied(plan, trials).filter(scenario) for name, plan in plans().items()
    }
    starts = _studied(plans()["`ekf`, Q and R"], trials), default
    filters |= {
        f"`ekf` + {name}": lambda names=names: tuned_augmented(scenario, names, starts, 2 * trials)
        for name, names in UNKNOWNS.items()
    }
    filters[RIGHT] = lambda: scaled_default("ekf", known, SEED).choice.filter(known)
    base = evaluate(default.filter(scenario), held_out, scenario.scale)
    lines = [_line("`ekf`, scaled default", base, base)]
    for name in rows if rows is not None else filters:
        lines.append(_line(name, evaluate(filters[name](), held_out, scenario.scale), base))
    return markdown_table(COLUMNS, lines)


def _studied(plan: Plan, trials: int) -> Choice:
    return run_study(open_study("page", plan, None), plan, trials).choice


def _line(name: str, evaluation: Evaluation, base: Evaluation) -> list[str]:
    ratio, (speed, flow) = score_ratio(evaluation, base), evaluation.rmse
    cells = f"{ratio.value:.3f} ± {(ratio.high - ratio.low) / 2:.3f}", f"{speed.value:.3f}", f"{flow.value:.4f}"
    nees = evaluation.nees.value
    return [name, *cells, f"{nees:.3g}" if nees < 1000 else "> 1000", f"{evaluation.nis.value:.2f}"]


TABLES: dict[str, Callable[[], str]] = {"bought": bought}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    make_page("tuning", "pages.tuning_mismatch", {}, TABLES, __doc__.splitlines()[0], arguments)


if __name__ == "__main__":
    main()
