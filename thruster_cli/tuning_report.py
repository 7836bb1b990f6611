"""What `thruster tune` says of a study: tables and sentences, or plain data."""

from __future__ import annotations

from math import isfinite

from numpy import isnan
from rich.console import RenderableType

from filters.consistency.intervals import Interval
from filters.consistency.verdicts import mean_sentence
from thruster_cli.error_tables import comparison_table, span
from thruster_cli.tables import choice_table, front_table, gradient_table, kinds_table
from tuning.api.run import Tuning
from tuning.evaluation.baselines import ORACLE, RULE, SCALED, TUNED, baselines
from tuning.evaluation.evaluate import Evaluation, likelihood_gain, score_ratio
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.sizes import SIZE_TOLERANCE
from tuning.evaluation.tuned import consistency, metrics
from tuning.evaluation.worth import scaling_sentence, sized, without_truth
from tuning.likelihood.gradient import GradientResult
from tuning.likelihood.identifiability import as_data, sentences, too_many
from tuning.search.filter_types import kinds_tried
from tuning.search.objectives import NIS_BAND
from tuning.search.outcome import is_over_budget
from tuning.search.plan import Plan
from tuning.search.space import size_ladder
from tuning.search.study import StudyResult


def report(tuning: Tuning) -> list[RenderableType]:
    """Tables and sentences that say what a tuning found and what it is worth."""
    result, plan = tuning.result, tuning.plan
    shown: list[RenderableType] = []
    for scenario, proof in zip(plan.scenarios, tuning.proofs, strict=True):
        found = {TUNED: result.choice, **baselines(result.choice.name, scenario, plan.seed)}
        evaluations = proof.evaluations
        choices = {proof.label(name): found[name] for name in evaluations}
        span_of_seeds = f"{scenario.seed_word} {proof.seeds.start} to {proof.seeds.stop - 1}"
        where = f"held-out {span_of_seeds}, scenario {scenario.name}"
        shown += [choice_table(choices, scenario), comparison_table(proof.labelled, proof.bound, where)]
        shown += gains(proof, scenario.seed_word)
        shown.append(_consistency_sentence(proof.tuned))
        if proof.tuned.has_truth and isnan(proof.bound).all():
            shown.append(
                f"{scenario.name} has no bound: there is none for a singular Q, or if the plant is no model. Its "
                "score is RMSE over its scale."
            )
    shown += sentences(tuning.known) if tuning.known else too_many(result.choice, plan.space())
    shown += _search_sentences(tuning)
    trained = f"{result.finished} trials, {result.pruned} of them pruned, {result.seconds:.1f} s in this run"
    over = sum(map(is_over_budget, result.trials))
    trained += f"; {over} ended for their cost" if over else ""
    shown.append(f"Study {tuning.study!r}: {trained}. Tuned filter: {tuning.file}")
    if result.interrupted:
        shown.append("Interrupted: this is on the trials that were finished; the same command goes on.")
    return shown


def _search_sentences(tuning: Tuning) -> list[RenderableType]:
    """What the search itself has to say: sizes, the price of consistency, optimism, a front, a maximum."""
    result, plan, word = tuning.result, tuning.plan, tuning.scenario.seed_word
    if tuning.gradient is not None and tuning.rival is not None:  # which come together
        said = _gradient_sentences(tuning, tuning.gradient, tuning.rival)
        return [gradient_table(tuning.gradient, word), *said]
    shown: list[RenderableType] = []
    kinds = kinds_tried(result.trials)
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
    if result.consistent is False:
        shown.append(_none_consistent(result, plan))
    elif result.free_value is not None:
        price = 100 * (result.best_value / result.free_value - 1)
        shown.append(
            f"Consistency costs {price:.1f} % of the score on the training {word}: the best trial has "
            f"{result.free_value:.3f} whatever its NIS, {result.best_value:.3f} with it in its band."
        )
    if plan.objectives == ("score",):  # which needs truth
        found = sum(proof.tuned.score.value for proof in tuning.proofs) / len(tuning.proofs)
        shown.append(
            f"Optimism: the best trial scores {result.best_value:.3f} on the training {word}, the tuned filter "
            f"{found:.3f} on the held-out ones."
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
        "kinds": [kind._asdict() for kind in kinds_tried(result.trials)],
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


def gains(proof: Comparison, seed_word: str) -> list[str]:
    """What tuning is worth, over each baseline, the one that counts first, and what that one is."""
    if not proof.tuned.has_truth:
        return _likelihood_gains(proof, seed_word)
    ratios = proof.ratios
    parts = [f"x {span(ratio, 3)} that of the {proof.label(name)}" for name, ratio in ratios.items()]
    first, place = next(iter(ratios)), f"{len(proof.seeds)} held-out {seed_word}"
    said = f"Score of the tuned filter on {place}: {', '.join(parts)} (paired 95 % intervals)."
    scaling = scaling_sentence(proof)
    return [f"{said} {_verdict(ratios[first], proof.label(first), seed_word)}", *([scaling] if scaling else [])]


def _likelihood_gains(proof: Comparison, seed_word: str) -> list[str]:
    """What tuning is worth where there is no truth: by how much the log-likelihood of a run rises."""
    gained = {name: found for name, found in proof.likelihood_gains.items() if not isnan(found.value)}
    said, scaling = [without_truth("This problem")], scaling_sentence(proof)
    if gained:
        parts = [
            f"{span(sized(found), 2)} {'above' if found.value >= 0 else 'below'} that of the {proof.label(name)}"
            for name, found in gained.items()
        ]
        place = f"{len(proof.seeds)} held-out {seed_word}"
        said.append(f"Log-likelihood of a run of the tuned filter on {place}: {', '.join(parts)}.")
    return [*said, *([scaling] if scaling else [])]


def _verdict(ratio: Interval, name: str, seed_word: str) -> str:
    if ratio.high < 1:
        return f"Tuning lowers the error by {100 * (1 - ratio.value):.0f} % against the {name}."
    if ratio.low > 1:
        return f"Tuning makes it worse than the {name}."
    return f"No difference from the {name} that these {seed_word} can show."


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
