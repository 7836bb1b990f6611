"""Make the picture of docs/tuning.md and its computed tables.

    python -m pages.tuning_figures [FOLDER]

The picture goes into FOLDER, docs/ by default. If there is a tuning.md in it, its tables between the comments
`<!-- table NAME -->` and `<!-- end -->` are written anew, which takes some minutes. Every run gives the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from filters.consistency.intervals import Interval
from pages.page import log_ticks, make_page
from pages.tuning_masses import TABLES as MASSES_TABLES
from pages.tuning_recovery import TABLES as RECOVERY_TABLES
from pages.tuning_recovery import bad_start
from thruster_env.core.plots import BLUE, DARK, RUST, new_figure, save_figure, tidy
from thruster_env.core.text_tables import markdown_table
from tuning.evaluation.baselines import ORACLE, RULE, SCALED
from tuning.evaluation.evaluate import Evaluation, evaluate, score_ratio
from tuning.evaluation.held_out import evaluate_held_out
from tuning.likelihood.gradient import tune_by_gradient
from tuning.search.objectives import LIKELIHOOD, LOG_SCORE, MSE, NIS_BAND, SCORE
from tuning.search.plan import Plan
from tuning.search.space import Choice
from tuning.search.study import StudyResult, open_study, quiet_optuna, run_study
from tuning.thruster.scenario import Scenario, find_scenario

SEED, TRIALS = 0, 100
COLUMNS = [
    "scenario",
    "filter",
    *(f"over {name}" for name in (SCALED, RULE, ORACLE)),
    "N",
    "NEES",
    "NIS",
    "price of NIS",
]
FILTERS = ("kf", "ekf", "enkf")
EARNING = ("mismatch", "ambient", "deadband", "outliers")  # where the true Q and R are not the best ones
FACTORS = np.geomspace(1e-3, 1e3, 31)


def ridge(path: Path) -> Path:
    """Score and mean NIS of an EKF over common factors on Q and on R."""
    scenario = find_scenario("nominal")
    data = Plan("ekf", (scenario,), SEED).training_data()[0]
    evaluations = [[_scaled(scenario, data, q, r) for q in FACTORS] for r in FACTORS]
    scores, ratios = np.array([[(e.score.value, e.nis.value) for e in row] for row in evaluations]).transpose(
        2, 0, 1
    )
    figure = new_figure((9.6, 4.0))
    plane, line = figure.subplots(1, 2, width_ratios=(3, 2))
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
    tidy([plane, line])
    plane.legend(loc="upper left", fontsize=8)
    line.legend(frameon=False)
    return save_figure(figure, path)


def _scaled(scenario: Scenario, data, q: float, r: float) -> Evaluation:
    model = {
        "process_noise_cov": tuple(q * v for v in scenario.process_noise_cov),
        "measurement_noise_cov": r * scenario.measurement_noise_cov,
    }
    return evaluate(Choice("ekf", model, {}).filter(scenario), data, scenario.scale)


def studied(name: str, scenario: Scenario, start: Choice | None = None, trials: int = TRIALS) -> StudyResult:
    """A study in memory."""
    quiet_optuna()
    plan = Plan(name, (scenario,), SEED)
    return run_study(open_study("page", plan, None, start), plan, trials).or_interrupted()


def earned(scenarios: Sequence[str] = EARNING, trials: int = TRIALS) -> str:
    """What a study gains over the scaled default, the rule of thumb and the oracle."""
    rows = []
    for name in scenarios:
        scenario = find_scenario(name)
        for kind in FILTERS:
            result = studied(kind, scenario, trials=trials)
            comparison = evaluate_held_out(result.choice, scenario, SEED)
            ratio_of = comparison.ratios
            ratios = [
                _about(ratio_of[baseline]) if baseline in ratio_of else "none"
                for baseline in (SCALED, RULE, ORACLE)
            ]
            ratios.append(f"{result.choice.numbers['ensemble_size']}" if result.sizes else "")
            nees = comparison.tuned.nees.value
            honesty = f"{nees:.3g}" if nees < 1000 else "> 1000", f"{comparison.tuned.nis.value:.2f}"
            met = result.validation  # whose price decides between a mean NIS in its band and the log score
            price = "" if met is None or met.price is None else f"{100 * met.price:.1f} %"
            rows.append([f"`{name}`" if kind == FILTERS[0] else "", f"`{kind}`", *ratios, *honesty, price])
    return markdown_table(COLUMNS, rows)


def recovered() -> str:
    """Studies of a perfect linear model, from a bad start."""
    rows = []
    for name in ("published_tunnel", "published_open_bladed"):
        scenario = find_scenario(name)
        bad = bad_start("kf", scenario)
        comparison = evaluate_held_out(studied("kf", scenario, bad).choice, scenario, SEED)
        started = evaluate(bad.filter(scenario), scenario.data(comparison.seeds), scenario.scale)
        ratios = (score_ratio(evaluation, comparison.true) for evaluation in (started, comparison.tuned))
        rows.append([f"`{name}`", *(_about(ratio, 4) for ratio in ratios)])
    return markdown_table(["scenario", "start over oracle", "tuned over oracle"], rows)


def maximum_likelihood() -> str:
    """The maximum of the likelihood beside the true numbers."""
    scenario = find_scenario("nominal")
    result = tune_by_gradient("ekf", scenario, Plan("ekf", (scenario,), SEED).training_data()[0])
    true = (*scenario.process_noise_cov, scenario.measurement_noise_cov)
    columns = zip(result.names, true, result.best.parameters, result.standard_errors, strict=True)
    rows = [[name, f"{value:.4g}", f"{best:.4g}", f"{100 * error:.0f} %"] for name, value, best, error in columns]
    return markdown_table(["", "true", "most likely", "standard error"], rows)


def aims() -> str:
    """Where the gradients of three objectives lead where the model is wrong, beside a study of the score."""
    scenario = find_scenario("mismatch")
    data = Plan("ekf", (scenario,), SEED).training_data()[0]
    rows = []
    for aim in (LIKELIHOOD, SCORE, MSE, LOG_SCORE):
        result = tune_by_gradient("ekf", scenario, data, objective=aim)
        rows.append(_proved(f"gradient of `{aim}`", result.choice, scenario, result.names, result.identified))
    choice = studied("ekf", scenario).choice
    rows.append(_proved(f"study of `score`, {TRIALS} trials", choice, scenario))
    return markdown_table(["", "score over the scaled default", "NEES", "NIS", "not determined"], rows)


def _proved(what: str, choice: Choice, scenario: Scenario, names=(), identified=()) -> list[str]:
    comparison = evaluate_held_out(choice, scenario, SEED)
    loose = ", ".join(name for name, known in zip(names, identified, strict=True) if not known)
    ratio, tuned = comparison.ratios[SCALED], comparison.tuned
    return [what, _about(ratio), f"{tuned.nees.value:.3g}", f"{tuned.nis.value:.3g}", loose]


def _about(value: Interval, digits: int = 3) -> str:
    return f"{value.value:.{digits}f} ± {(value.high - value.low) / 2:.{digits}f}"


FIGURES: dict[str, Callable[[Path], Path]] = {"tuning_ridge.png": ridge}
TABLES: dict[str, Callable[[], str]] = {
    table.__name__: table for table in (earned, recovered, maximum_likelihood, aims)
}
TABLES |= RECOVERY_TABLES | MASSES_TABLES


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    make_page("tuning", "pages.tuning_figures", FIGURES, TABLES, __doc__.splitlines()[0], arguments)


if __name__ == "__main__":
    main()
