"""What `thruster tune` says of a study: tables and sentences, or plain data."""

from __future__ import annotations

from math import isfinite

from numpy import isnan
from rich.console import RenderableType

from filters.consistency.intervals import slightly
from filters.consistency.verdicts import mean_sentence
from numerics.modules import is_code
from thruster_cli.tables import choice_table, front_table, gradient_table, kinds_table
from tuning.api.run import Tuning
from tuning.evaluation.baselines import ORACLE, RULE, SCALED, TUNED, baselines
from tuning.evaluation.evaluate import Evaluation, likelihood_gain, score_ratio
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.sizes import SIZE_TOLERANCE
from tuning.evaluation.tuned import consistency, metrics
from tuning.likelihood.gradient import GradientResult
from tuning.likelihood.identifiability import as_data, sentences, too_many
from tuning.problems.rooms import built_in
from tuning.reporting.error_tables import comparison_table, span
from tuning.reporting.gains import gains
from tuning.search.filter_types import filter_types_tried
from tuning.search.objectives import NIS_BAND
from tuning.search.outcome import is_over_budget
from tuning.search.plan import Plan
from tuning.search.space import size_ladder
from tuning.search.study import StudyResult


def report(tuning: Tuning) -> list[RenderableType]:
    """What a tuning is worth, where its filter is and what to do next; then tables and sentences on it all."""
    result, plan = tuning.result, tuning.plan
    shown: list[RenderableType] = []
    for scenario, proof in zip(plan.scenarios, tuning.proofs, strict=True):
        where = f"{scenario.name}: " if len(tuning.proofs) > 1 else ""
        first, *others = gains(proof, scenario.seed_word)
        shown += [f"{where}{first}", *others]
    if result.consistent is False:
        shown.append(_none_consistent(result, plan))
    shown += [*way_out(tuning), *next_steps(tuning), ""]
    for scenario, proof in zip(plan.scenarios, tuning.proofs, strict=True):
        found = {TUNED: result.choice, **baselines(result.choice.name, scenario, plan.seed)}
        evaluations = proof.evaluations
        choices = {proof.label(name): found[name] for name in evaluations}
        span_of_seeds = f"{scenario.seed_word} {proof.seeds.start} to {proof.seeds.stop - 1}"
        where = f"held-out {span_of_seeds}, scenario {scenario.name}"
        shown += [
            choice_table(choices, scenario),
            comparison_table(proof.labelled, proof.bound, where, scenario.scale_about),
        ]
        shown.append(_consistency_sentence(proof.tuned))
        if proof.tuned.has_truth and isnan(proof.bound).all():
            shown.append(
                f"{scenario.name} has no bound: there is none for a singular Q, or if the plant is no model. Its "
                f"score is RMSE over {scenario.scale_about}."
            )
    shown += sentences(tuning.known) if tuning.known else too_many(result.choice, plan.space())
    shown += _search_sentences(tuning)
    trained = f"{result.finished} trials, {result.pruned} of them pruned, {result.seconds:.1f} s in this run"
    over = sum(map(is_over_budget, result.trials))
    trained += f"; {over} ended for their cost" if over else ""
    return [*shown, f"Study {tuning.study!r}: {trained}."]


def way_out(tuning: Tuning) -> list[str]:
    """What to do where the tuned filter is worse than the best of what anybody has; empty where it is not."""
    ratios = [next(iter(proof.ratios.items())) for proof in tuning.proofs if proof.tuned.has_truth]
    worse = [name for name, ratio in ratios if ratio.low > 1 and not slightly(ratio)]
    if not worse or tuning.gradient is not None:
        return []
    pruning = ", or without pruning (--no-pruning)" if tuning.plan.prune else ""
    return [
        f"What may help: more trials (--trials {2 * tuning.result.finished}){pruning}. The file below holds the "
        f"tuned filter all the same; Q and R of the {worse[0]} are in the table."
    ]


def next_steps(tuning: Tuning) -> list[str]:
    """Where the tuned filter is, and the command that shows more of it; of an interrupted study how it goes on."""
    shown = [f"Tuned filter: {tuning.file}"]
    names = [one.name for one in tuning.plan.scenarios if is_code(one.name) and one.name not in built_in()]
    shown.append(f"Next: thruster report {tuning.file}{''.join(f' --problem {name}' for name in names)}")
    if tuning.result.interrupted:
        shown.append("Interrupted: this is on the trials that were finished; the same command goes on.")
    return shown


def _search_sentences(tuning: Tuning) -> list[RenderableType]:
    """What the search itself has to say: sizes, the price of consistency, optimism, a front, a maximum."""
    result, plan, word = tuning.result, tuning.plan, tuning.scenario.seed_word
    if tuning.gradient is not None and tuning.rival is not None:  # which come together
        said = _gradient_sentences(tuning, tuning.gradient, tuning.rival)
        return [gradient_table(tuning.gradient, word), *said]
    shown: list[RenderableType] = []
    kinds = filter_types_tried(result.trials)
    if kinds:
        shown.append(kinds_table(kinds, plan))
    if plan.budget is not None:
        shown.append(
            f"A step of the tuned {result.choice.name} takes {result.microseconds:.3g} microseconds of one core; "
            f"the budget is {plan.budget:g}."
        )
    if result.sizes:
        kept, ladder = result.choice.numbers["ensemble_size"], size_ladder(result.choice.name)
        ratios = ", ".join(
            f"{r.size}: {r.ratio.value:.3f} [{r.ratio.high:.3f}]" for r in result.sizes if r.size in ladder
        )
        shown.append(
            f"Score over the best by ensemble size, on {word} that chose neither Q nor R, with the upper end of "
            f"its 95 % interval: {ratios}. {_size_sentence(kept, result)}{_seeds_sentence(result, word)}"
        )
    if result.consistent is not False and result.free_value is not None:
        price = 100 * (result.best_value / result.free_value - 1)
        shown.append(
            f"Consistency, a mean NIS (normalised innovation squared) in its band, costs {price:.1f} % of the "
            f"score on the training {word}: the best trial has {result.free_value:.3f} whatever its NIS, "
            f"{result.best_value:.3f} with it in the band."
        )
    if plan.objectives == ("score",):  # which needs truth
        found = sum(proof.tuned.score.value for proof in tuning.proofs) / len(tuning.proofs)
        shown.append(
            f"Optimism, by how much the score flatters on the {word} that chose the filter: the best trial has "
            f"{result.best_value:.3f} on the training {word}, the tuned filter {found:.3f} on the held-out ones."
        )
    if result.front:
        shown.append(front_table(plan, result.front))
    return shown


def _none_consistent(result: StudyResult, plan: Plan) -> str:
    word = plan.scenarios[0].seed_word
    ratios = [f"{ratio:.3g}" if isfinite(ratio) else "beyond all numbers" for ratio in result.nis]
    return (
        f"No trial was consistent: a mean NIS must lie between {NIS_BAND[0]:g} and {NIS_BAND[1]:g} of its "
        f"expected value, but the tuned filter's is {' and '.join(ratios)} on the training {word}. It is the "
        f"trial with the least {plan.objectives[0]}; do not rely on its covariance."
    )


def _gradient_sentences(tuning: Tuning, gradient: GradientResult, rival: Comparison) -> list[str]:
    ours, theirs = tuning.proof.tuned, rival.tuned
    loose = [name for name, known in zip(gradient.names, gradient.identified, strict=True) if not known]
    words = []
    if loose:
        words.append(
            f"The data do not determine {', '.join(loose)}: the 95 % interval reaches beyond a factor of ten, or "
            "the maximum lies at the end of the range."
        )
    agree = (
        "All starts lead to one maximum."
        if gradient.agree
        else "Starts lead to different maxima: the best is kept."
    )
    over = (
        f"Score over Optuna's on the held-out {tuning.scenario.seed_word}: {span(score_ratio(ours, theirs), 3)}."
    )
    if not ours.has_truth:
        over = f"Log-likelihood of a held-out run above Optuna's: {span(likelihood_gain(ours, theirs), 2)}."
    words.append(
        f"{agree} It took {gradient.seconds:.1f} s; {tuning.result.finished} trials of Optuna took "
        f"{tuning.result.seconds:.1f} s in this run. {over}"
    )
    return words


def as_json(tuning: Tuning) -> dict:
    """The result of a tuning as plain data."""
    result, plan = tuning.result, tuning.plan
    held_out = {
        scenario.name: {**metrics(proof), **ratios_as_json(proof)}
        for scenario, proof in zip(plan.scenarios, tuning.proofs, strict=True)
    }
    data = {
        "study": tuning.study,
        "plan": plan.identity,
        "filter": result.choice._asdict(),
        "trials": result.finished,
        "pruned": result.pruned,
        "microseconds_a_step": result.microseconds,
        "kinds": [kind._asdict() for kind in filter_types_tried(result.trials)],
        "best_training_value": result.best_value,
        "best_training_value_without_consistency": result.free_value,
        **consistency(result),
        "interrupted": result.interrupted,
        "sizes": [
            {
                "N": r.size,
                "ratio": r.ratio.value,
                "upper_end": r.ratio.high,
                "score": r.evaluation.score.value,
                "seeds": r.seeds,
            }
            for r in result.sizes
        ],
        "front": [{"values": trial.values, "parameters": trial.params} for trial in result.front],
        "held_out": held_out,
        "file": str(tuning.file),
    }
    if tuning.known is not None:
        data["innovations_alone"] = as_data(tuning.known)
    if tuning.gradient is not None and tuning.rival is not None:
        found = tuning.gradient
        data["gradient"] = {
            "log_likelihood": found.best.log_likelihood,
            "standard_errors_of_logarithms": dict(zip(found.names, found.standard_errors.tolist(), strict=True)),
            "identified": dict(zip(found.names, found.identified.tolist(), strict=True)),
            "agree": found.agree,
            "seconds": found.seconds,
            "score_over_optuna": score_ratio(tuning.proof.tuned, tuning.rival.tuned),
        }
    return data


def ratios_as_json(proof: Comparison) -> dict:
    """Score of the tuned filter over that of each baseline; None where there is no such baseline."""
    ratios, names = proof.ratios, {"scaled": SCALED, "untuned": RULE, "true": ORACLE}
    return {f"tuned_over_{key}": ratios.get(name) for key, name in names.items()}


def _size_sentence(kept: int, result: StudyResult) -> str:
    ends = {row.size: row.ratio.high for row in result.sizes}
    if ends[kept] < 1 + SIZE_TOLERANCE:
        return f"N = {kept} is the smallest whose upper end is below {1 + SIZE_TOLERANCE:g}."
    return f"No N has its upper end below {1 + SIZE_TOLERANCE:g} on all scenarios; N = {kept} is a compromise."


def _seeds_sentence(result: StudyResult, word: str) -> str:
    """Which sizes few runs left out; empty where all were run on all of them."""
    counts = {row.seeds for row in result.sizes}
    if len(counts) < 2:
        return ""
    whole = ", ".join(str(row.size) for row in result.sizes if row.seeds == max(counts))
    return f" The first {min(counts)} {word} left out the others before N = {whole} were run on {max(counts)}."


def _consistency_sentence(evaluation: Evaluation) -> str:
    if not evaluation.has_truth:
        return mean_sentence("NIS", evaluation.nis, evaluation.expected_nis)
    said = mean_sentence("NEES", evaluation.nees, len(evaluation.rmse))
    return (
        said if said.startswith("Consistent") else f"{said} RMSE and NIS alone do not see all of the covariance."
    )
