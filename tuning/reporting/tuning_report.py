"""What `thruster tune` reports on a study: tables and sentences, or plain data."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from shlex import quote
from typing import TYPE_CHECKING

import numpy as np

from filters.consistency.nees import slightly, span
from filters.consistency.report import mean_sentence
from filters.filter import Filter
from thruster_env.core.modules import is_code
from thruster_env.core.text_tables import Table
from tuning.evaluation.baselines import (
    GIVEN,
    NOISE,
    ORACLE,
    RULE,
    SCALED,
    baseline_size,
    baselines,
    called,
    same_filter,
)
from tuning.evaluation.evaluate import BLOW_UP_RUNS, blow_up, likelihood_gain, score_ratio
from tuning.evaluation.held_out import Comparison, numbers
from tuning.evaluation.sizes import SIZE_TOLERANCE, left_out
from tuning.evaluation.tuned import consistency, metrics
from tuning.evaluation.worth import memory_numbers, memory_sentence
from tuning.likelihood.gradient import GradientResult
from tuning.likelihood.identifiability import as_data, sentences, too_many
from tuning.likelihood.parametric import has_gradient
from tuning.logs.problem import model_named_in
from tuning.problems.assumed import within
from tuning.problems.data import Data, estimates_in_parts
from tuning.problems.find import built_in
from tuning.reporting.choice_words import (
    JOINTLY,
    MADE_UP,
    apart,
    consistency_of,
    gains,
    model_doubts,
    residual_sentences,
)
from tuning.reporting.tables import cell_of, kinds_table
from tuning.search.among_types import filter_types_tried
from tuning.search.parameters import index_pairs, size_ladder
from tuning.search.plan import LIKELIHOOD, NIS_BAND, PROPER, Plan, at_ends, range_words, reported, reported_name
from tuning.search.space import parameters_of
from tuning.search.study import StudyResult
from tuning.search.trials import is_over_budget
from tuning.search.validation import as_data as as_data_of_choice

if TYPE_CHECKING:
    from tuning.api.study import Study

MOST_VALUES = 8  # of a baseline, in a sentence


def report(tuning: Study) -> list[Table | str]:
    """The gain of a tuning, the path of its filter and the next command; then tables and sentences."""
    result, plan = tuning.result, tuning.plan
    output: list[Table | str] = [*tuning.chosen]
    for scenario, comparison in zip(plan.scenarios, tuning.comparisons, strict=True):
        where = f"{scenario.name}: " if len(tuning.comparisons) > 1 else ""
        gained, doubts = gains(comparison, scenario.seed_word), model_doubts(scenario, comparison, plan.seed)
        headline = 1 if comparison.tuned.has_truth else len(gained)
        output += [f"{where}{gained[0]}", *gained[1:headline], *doubts, *gained[headline:]]
    if result.consistent is False:
        output.append(_none_consistent(result, plan))
    output += [*(blown_up(tuning) or way_out(tuning)), *next_steps(tuning), ""]
    output += [remark for scenario in plan.scenarios for remark in scenario.remarks]
    for scenario, evaluation in zip(plan.scenarios, tuning.evaluations, strict=True):
        comparison = evaluation.comparison
        output += evaluation.numbers_and_errors()
        output += [consistency_sentence(comparison), memory_sentence(comparison.tuned, scenario)]
        output += residual_sentences(scenario, plan.seed)
    output += at_ends(result.choice, plan)
    output += sentences(tuning.known) if tuning.known else too_many(result.choice, plan.space())
    output += _search_sentences(tuning)
    trained = f"{result.finished} trials, {result.pruned} of them pruned, {result.seconds:.1f} s in this run"
    over = sum(map(is_over_budget, result.trials))
    trained += f"; {over} stopped at the budget" if over else ""
    return [*output, f"Study {tuning.name!r}: {trained}."]


def blown_up(tuning: Study) -> list[str]:
    """Advice on a model that diverges between samples, where no Q and R help; empty if it does not."""
    advice = []
    for scenario, comparison in zip(tuning.plan.scenarios, tuning.comparisons, strict=True):
        data = scenario.data(comparison.seeds)
        advice.append(blow_up_on(tuning.result.choice.filter(scenario), data, scenario.dt))
    return [sentence for sentence in dict.fromkeys(advice) if sentence]


def way_out(tuning: Study) -> list[str]:
    """Advice if the tuned filter is significantly worse than a baseline but the oracle; empty otherwise."""
    better = [name for comparison in tuning.comparisons if (name := _best_instead(comparison))]
    if not better:
        return []
    if tuning.plan.forget is not None:
        return [
            f"That is the price of forgetting within {tuning.plan.forget:g} s (--forget): the baselines in the "
            "table may remember longer."
        ]
    if tuning.gradient is not None or tuning.answer is not None:
        return [
            f"What to take: the {called(better[0])}{_noise_words(tuning, better[0])}. The same command without "
            f"--method {tuning.method} runs a study, which ends with the best baseline if no trial is better."
        ]
    pruning = ", or without pruning (--no-pruning)" if tuning.plan.prune else ""
    pruning += ", or maximum likelihood (--method gradient)" if has_gradient(tuning.plan.filter) else ""
    return [
        f"What may help: more trials (--trials {2 * tuning.result.finished}){pruning}. The file below still "
        f"contains the tuned filter; Q and R of the {called(better[0])} are in the table."
    ]


def _best_instead(comparison: Comparison) -> str:
    """The best baseline but the oracle that is significantly better than the tuned filter; empty without one."""
    if comparison.tuned.has_truth:
        margins = {
            name: ratio.value for name, ratio in comparison.ratios.items() if ratio.low > 1 and not slightly(ratio)
        }
    else:
        margins = {name: -gain.value for name, gain in comparison.likelihood_gains.items() if gain.high < 0}
    margins.pop(ORACLE, None)
    return max(margins, key=lambda name: margins[name], default="")


def _noise_words(tuning: Study, name: str) -> str:
    """The values of a baseline, after its name; of many where they are."""
    choice, plan = tuning.result.choice, tuning.plan
    choices = baselines(choice.name, plan.scenarios[0], plan.seed, ensemble_size=baseline_size(choice))
    values = parameters_of(choices[name]) if name in choices else {}
    if not 0 < len(values) <= MOST_VALUES:
        return (
            ", whose Q and R --method noise-estimation saves"
            if name == NOISE
            else ", whose Q and R are in the table"
        )
    return f" ({', '.join(f'{index_pairs(key)} = {value:.4g}' for key, value in values.items())})"


def next_steps(tuning: Study) -> list[str]:
    """The path of the tuned filter, and the next command; for an interrupted study how to continue it."""
    output = [f"Tuned filter: {tuning.file}"]
    problems = tuning.plan.scenarios
    plain = [*map(within, problems)]
    options = [
        f"--problem {problem.name}"
        for problem in plain
        if is_code(problem.name) and problem.name not in built_in()
    ]
    options += [f"--model {name}" for name in dict.fromkeys(map(model_named_in, plain)) if name is not None]
    output.append(" ".join([f"Next: thruster report {quote(str(tuning.file))}", *options]))
    if tuning.file is None:  # in Python, where nobody asked for one
        output = ["Next: study.save(FILE) writes the tuned filter for commands and EstimateState."]
    if tuning.result.interrupted:
        output.append("Interrupted: this is the result of the finished trials; the same command continues.")
    return output


def _search_sentences(tuning: Study) -> list[Table | str]:
    """Results of the search: sizes, the price of consistency, optimism, a front, a maximum."""
    result, plan, word = tuning.result, tuning.plan, tuning.problem.seed_word
    if tuning.gradient is not None and tuning.rival is not None:  # which come together
        text = _gradient_sentences(tuning, tuning.gradient, tuning.rival)
        return [gradient_table(tuning.gradient, word), *text]
    output: list[Table | str] = []
    kinds = filter_types_tried(result.trials)
    if kinds:
        output.append(kinds_table(kinds, plan))
    if plan.budget is not None:
        output.append(
            f"A step of the tuned {result.choice.name} takes {result.microseconds:.3g} microseconds of one core; "
            f"the budget is {plan.budget:g}."
        )
    if result.sizes:
        size, ladder = result.choice.numbers["ensemble_size"], size_ladder(result.choice.name)
        ratios = ", ".join(
            f"{r.size}: {r.ratio.value:.3f} [{r.ratio.high:.3f}]" for r in result.sizes if r.size in ladder
        )
        output.append(
            f"Score relative to the best, by ensemble size{_sized_trial(result)}, on separate {word}, with the "
            f"upper end of its 95 % interval: {ratios}. "
            f"{_size_sentence(size, result)}{_seeds_sentence(result, word)}"
        )
    met = result.validation
    in_band = met is None or (not met.gave_way and met.named(met.chosen).consistent)
    if in_band and result.free_value is not None and result.band_value is not None:
        output += _band_sentence(plan.objectives[0], result.free_value, result.band_value, word)
    if plan.objectives == ("score",):  # which needs truth
        score = sum(comparison.tuned.score.value for comparison in tuning.comparisons) / len(tuning.comparisons)
        trained, proved = apart(result.best_value, score)
        output.append(
            f"Optimism: the score of the tuned filter is {trained} on the training {word}, which chose it, and "
            f"{proved} on the held-out {word}."
        )
    if result.front:
        output.append(front_table(plan, result.front))
    return output


def _band_sentence(objective: str, free: float, best: float, word: str) -> list[str]:
    """The cost of a mean NIS in its band on the training runs, in a list; empty if the best trial of all has one.

    It is a part of an error or a difference of logarithms, with the ensemble sizes at which the trials were run.
    """
    if best <= free:
        return []
    name, levels = reported_name(objective), [reported(objective, value) for value in (free, best)]
    price = (
        f"{levels[0] - levels[1]:.3g} of {name}"
        if objective in PROPER
        else f"{100 * (best / free - 1):.1f} % of {name}"
    )
    with_any, within = apart(*levels)
    return [
        f"A mean NIS (normalised innovation squared) in its band costs {price} on the training {word}: the best "
        f"trial of all has {with_any}, the best in the band {within}."
    ]


def _none_consistent(result: StudyResult, plan: Plan) -> str:
    word, channels = plan.scenarios[0].seed_word, len(plan.scenarios[0].innovations)
    means = [f"{channels * ratio:.3g}" if isfinite(ratio) else "infinite" for ratio in result.nis]
    low, high = (channels * end for end in NIS_BAND)
    end = "largest" if plan.objectives[0] in PROPER else "smallest"
    best = f"the trial with the {end} {reported_name(plan.objectives[0])}"
    which = "the baseline above" if gave_way(result) else best
    return (
        f"No trial was consistent: a mean NIS must lie between {low:g} and {high:g}, where {channels} is right, "
        f"but the tuned filter's is {' and '.join(means)} on the training {word}. It is {which}; do not rely on "
        "its covariance."
    )


def gave_way(result: StudyResult) -> bool:
    """Whether the trials gave way to a baseline."""
    return result.validation is not None and result.validation.gave_way


def _gradient_sentences(tuning: Study, gradient: GradientResult, rival: Comparison) -> list[str]:
    ours, theirs = tuning.comparison.tuned, rival.tuned
    loose = [name for name, known in zip(gradient.names, gradient.identified, strict=True) if not known]
    words = []
    optimum, optima = ("maximum", "maxima") if gradient.objective in PROPER else ("minimum", "minima")
    if loose:
        words.append(
            f"The data do not determine {', '.join(loose)}: the 95 % interval exceeds a factor of ten (or half of "
            f"a range that is not logarithmic), or the {optimum} lies at the end of the range."
        )
    agree = (
        f"All starts reach the same {optimum}."
        if gradient.agree
        else f"Starts reach different {optima}: the best is kept."
    )
    over = (
        f"Score of the tuned filter over Optuna's on the held-out {tuning.problem.seed_word}: "
        f"{span(score_ratio(ours, theirs), 3)}."
    )
    if not ours.has_truth:
        gained = span(likelihood_gain(ours, theirs), 2)
        over = f"Log-likelihood of a held-out run of the tuned filter above Optuna's: {gained}."
    words.append(
        f"{agree} It took {gradient.seconds:.1f} s; {tuning.result.finished} trials of Optuna took "
        f"{tuning.result.seconds:.1f} s in this run. {over}"
    )
    return words


def as_json(tuning: Study) -> dict:
    """The result of a tuning as plain data."""
    result, plan = tuning.result, tuning.plan
    held_out = {
        scenario.name: {
            **metrics(comparison),
            **ratios_as_json(comparison),
            "likelihood_over_regression": numbers(comparison.over_regression),
            "doubts": model_doubts(scenario, comparison, plan.seed),
        }
        for scenario, comparison in zip(plan.scenarios, tuning.comparisons, strict=True)
    }
    data = {
        "study": tuning.name,
        "plan": plan.identity,
        "filter": result.choice._asdict(),
        "trials": result.finished,
        "pruned": result.pruned,
        "microseconds_a_step": result.microseconds,
        "kinds": [kind._asdict() for kind in filter_types_tried(result.trials)],
        "at_ends": at_ends(result.choice, plan),
        "ranges": range_words(plan),
        "choice": as_data_of_choice(result.validation),
        "best_training_value": result.best_value,
        "best_training_value_without_consistency": result.free_value,
        **consistency(result),
        "warnings": list(tuning.warnings),
        "memory": {
            scenario.name: memory_numbers(comparison, scenario, plan.forget)
            for scenario, comparison in zip(plan.scenarios, tuning.comparisons, strict=True)
        },
        "blows_up": blown_up(tuning),
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
        "method": {
            "name": tuning.method,
            "runs": None if tuning.answer is None else tuning.answer.runs,
            "seconds": None if tuning.answer is None else tuning.answer.seconds,
        },
    }
    if tuning.known is not None:
        data["innovations_alone"] = as_data(tuning.known)
    if tuning.gradient is not None and tuning.rival is not None:
        gradient = tuning.gradient
        data["gradient"] = {
            "log_likelihood" if gradient.objective == LIKELIHOOD else gradient.objective: gradient.best.level,
            "standard_errors_of_logarithms": _errors(gradient, log=True),
            "standard_errors": _errors(gradient, log=False),
            "identified": dict(zip(gradient.names, gradient.identified.tolist(), strict=True)),
            "agree": gradient.agree,
            "seconds": gradient.seconds,
            "score_over_optuna": score_ratio(tuning.comparison.tuned, tuning.rival.tuned),
        }
    return data


def _errors(gradient: GradientResult, log: bool) -> dict[str, float]:
    """Standard errors of the parameters on logarithmic scales, or of the others, by name."""
    pairs = zip(gradient.free, gradient.standard_errors.tolist(), strict=True)
    return {parameter.name: error for parameter, error in pairs if parameter.log == log}


def ratios_as_json(comparison: Comparison) -> dict:
    """Score of the tuned filter over that of each baseline; None where there is no such baseline."""
    ratios, rule = comparison.ratios, RULE if comparison.rule == RULE else GIVEN
    names = {"given": GIVEN, "scaled": SCALED, "untuned": rule, "noise": NOISE, "true": ORACLE}
    return {f"tuned_over_{key}": ratios.get(name) for key, name in names.items()}


def _size_sentence(chosen: int, result: StudyResult) -> str:
    ends, without = {row.size: row.ratio.high for row in result.sizes}, left_out(result.sizes, chosen)
    among = ""
    if without:
        among = f", where N = {', '.join(map(str, without))} is left out: the mean NIS is outside its band"
    if gave_way(result):
        return (
            f"N = {chosen} is the smallest whose upper end is below {1 + SIZE_TOLERANCE:g}, but at least that of "
            f"the rule of thumb{among}."
        )
    if ends[chosen] < 1 + SIZE_TOLERANCE:
        return f"N = {chosen} is the smallest whose upper end is below {1 + SIZE_TOLERANCE:g}{among}."
    return f"No N has its upper end below {1 + SIZE_TOLERANCE:g} on all scenarios; N = {chosen} is a compromise."


def _sized_trial(result: StudyResult) -> str:
    """Which filter the sizes are of, if it is not the tuned one with another N."""
    same = result.sized is None or same_filter(result.sized, result.choice)
    return "" if same else " of the best trial"


def _seeds_sentence(result: StudyResult, word: str) -> str:
    """Which sizes were excluded after few runs; empty if all were run on all of them."""
    counts = {row.seeds for row in result.sizes}
    if len(counts) < 2:
        return ""
    sizes = ", ".join(str(row.size) for row in result.sizes if row.seeds == max(counts))
    return (
        f" The others were excluded on the first {min(counts)} {word} before N = {sizes} were run on "
        f"{max(counts)}."
    )


def blow_up_on(filter_: Filter, data: Data, dt: float | None) -> str:
    """`blow_up` of a filter on the first runs of some data."""
    first_runs = data.slice(0, BLOW_UP_RUNS)
    sentences = [
        blow_up(filter_, estimates, part, dt) for part, estimates in estimates_in_parts(filter_, first_runs)
    ]
    return next((sentence for sentence in sentences if sentence), "")


def consistency_sentence(comparison: Comparison) -> str:
    """The same in a sentence; a filter that predicts far worse than a regression is never called consistent."""
    name, mean, right, word = consistency_of(comparison)
    sentence = mean_sentence(name, mean, right)
    if word in (MADE_UP, JOINTLY):
        return f"{word[:1].upper()}{word[1:]}:{sentence.partition(':')[2]}"
    if not comparison.tuned.has_truth or sentence.startswith("Consistent"):
        return sentence
    return f"{sentence} RMSE and NIS do not fully test the covariance."


MOST_FACTORS = 4  # of a start, that fit into a caption


def front_table(plan: Plan, front: Sequence) -> Table:
    """The Pareto front of trials, the best in the first objective first."""
    names = list(dict.fromkeys(name for trial in front for name in trial.params))
    rows = [
        [str(trial.number + 1)]
        + [f"{reported(*pair):.4g}" for pair in zip(plan.objectives, trial.values, strict=True)]
        + [cell_of(trial.params.get(name, "")) for name in names]
        for trial in sorted(front, key=lambda trial: trial.values)
    ]
    caption = "No other trial is better in both objectives. The first one is the tuned filter."
    return Table(
        f"Pareto front on the training {plan.scenarios[0].seed_word}",
        ["trial", *map(reported_name, plan.objectives), *names],
        rows,
        caption=caption,
    )


def gradient_table(result: GradientResult, seed_word: str = "seeds") -> Table:
    """Where each start led, and how well the data determine the optimum."""
    likeliest = result.objective == LIKELIHOOD
    starts = "; ".join(", ".join(f"{factor:g}" for factor in factors) for factors in result.starts)
    caption = f"starts: factors {starts} on the untuned values" if len(result.free) <= MOST_FACTORS else ""
    rows = []
    for i, (parameter, error) in enumerate(zip(result.free, result.standard_errors.tolist(), strict=True)):
        of_factor = f"± {100 * error:.0f} %" if error < 1 else f"x/: {np.exp(error):.2g}"
        values = [f"{optimum.parameters[i]:.4g}" for optimum in result.optima]
        name = index_pairs(parameter.name) + (f" [{parameter.unit}]" if parameter.unit else "")
        rows.append([name, *values, of_factor if parameter.log else f"± {error:.2g}"])
    levels = [
        optimum.level if likeliest else reported(result.objective, optimum.level) for optimum in result.optima
    ]
    rows.append(
        [reported_name(result.objective), *(f"{level:{'.2f' if likeliest else '.6g'}}" for level in levels), ""]
    )
    rows.append(["evaluations", *(str(optimum.evaluations) for optimum in result.optima), ""])
    what = f"{'Maximum' if result.objective in PROPER else 'Minimum'} of {reported_name(result.objective)}"
    what = "Maximum of the innovations' likelihood" if likeliest else what
    titles = [f"start {i + 1}" for i in range(len(result.starts))]
    return Table(f"{what} on the training {seed_word}", ["", *titles, "standard error"], rows, caption=caption)
