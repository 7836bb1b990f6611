"""`HeldOut`: the performance of a filter and its baselines on held-out seeds, as a value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from filters.consistency.nees import Interval, SquaresCheck
from filters.consistency.report import MOST_STATES, ConsistencyReport, sentences, span
from filters.estimators.foreign import label_of
from filters.filter import Filter
from thruster_env.core.checks import at_least
from thruster_env.core.text_tables import Table
from tuning.api.result import Result, about, drawn, frame, number, plain_data
from tuning.evaluation.baselines import ORACLE, RULE, TUNED, baseline_size, baselines
from tuning.evaluation.evaluate import Evaluation, check_consistency, restart_sentences
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.tuned import metrics
from tuning.evaluation.worth import memory_sentence, scaling_sentence, warnings_of, without_truth
from tuning.problems.problem import Problem
from tuning.reporting.choice_words import gains, model_doubts, residual_sentences
from tuning.reporting.tables import choice_table, comparison_table
from tuning.search.space import Choice

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class HeldOut(Result):
    """A filter and its baselines on the same held-out seeds of a problem.

    Attributes:
        choice: the filter's parameters.
        problem: the problem.
        comparison: evaluations, bound and seeds.
        is_tuned: whether the choice is that of a study; otherwise it is the rule of thumb.
        seed: of the study to which the seeds belong.
        name: the filter's label, "tuned" or, for the user's parameters, "own numbers".
        chosen: a study's choice and what it replaced, in sentences.
        forget: the longest time constant that the study allowed [s]; None if any.
        covariance: whether it is consistent, if that was asked for.
    """

    choice: Choice
    problem: Problem
    comparison: Comparison
    is_tuned: bool = True
    seed: int = 0
    name: str = TUNED
    chosen: tuple[str, ...] = ()
    forget: float | None = None
    covariance: CovarianceCheck | None = None

    @property
    def filter(self) -> Filter:
        """The filter, with `init`, `predict` and `update`."""
        return self.choice.filter(self.problem)

    @property
    def evaluations(self) -> dict[str, Evaluation]:
        """The evaluation of each filter: "rule of thumb", "scaled default", "tuned", "oracle", if there is one."""
        evaluations = self.comparison.evaluations
        return {
            self._called(name): evaluation
            for name, evaluation in evaluations.items()
            if self.is_tuned or name != TUNED
        }

    def _called(self, name: str) -> str:
        return self.name if name == TUNED else name

    @property
    def evaluation(self) -> Evaluation:
        """The filter's own evaluation."""
        return self.comparison.tuned

    @property
    def choices(self) -> dict[str, Choice]:
        """The parameters of each filter."""
        choice, default = self.choice, self.comparison.default
        known = baselines(choice.name, self.problem, self.seed, default, baseline_size(choice))
        choices = {self.name: choice, **known}
        return {name: choices[name] for name in self.evaluations}

    @property
    def filters(self) -> dict[str, Filter]:
        """Each filter, ready to use: `EstimateState(env, filter=study.held_out.filters["scaled default"])`."""
        return {name: choice.filter(self.problem) for name, choice in self.choices.items()}

    @property
    def bound(self) -> np.ndarray:
        """Bound on the standard error of each state, (n,); NaN if there is none."""
        return self.comparison.bound

    @property
    def seeds(self) -> range:
        """The held-out seeds; for logs the indices of the held-out blocks."""
        return self.comparison.seeds

    @property
    def score(self) -> Interval:
        """Mean over states of RMSE over scale, with its 95 % interval; NaN without truth."""
        return self.evaluation.score

    @property
    def ratios(self) -> dict[str, Interval]:
        """Score over that of each baseline, paired, with 95 % intervals; below 1 is better."""
        return self.comparison.ratios

    @property
    def likelihood_gains(self) -> dict[str, Interval]:
        """Log-likelihood of a run minus that of each baseline, paired; it needs no truth."""
        return self.comparison.likelihood_gains

    def as_dict(self) -> dict[str, Any]:
        """All results as plain data, as in `thruster evaluate --json`."""
        data = metrics(self.comparison)
        if not self.is_tuned:
            del data["tuned"]
        warned = warnings_of(self.evaluation, self.problem, self.forget)
        checked = {} if self.covariance is None else {"consistency": self.covariance.as_dict()}
        what = {"filter": self.choice._asdict(), "scenario": self.problem.name}
        return plain_data({**what, **data, "warnings": warned, **checked})

    def to_frame(self) -> pandas.DataFrame:
        """A row per filter: RMSE of each state with its 95 % interval, score, NEES, NIS, log-likelihood, restarts.

        Raises:
            ValueError: if pandas is not installed.
        """
        columns: dict[str, list] = {"filter": list(self.evaluations)}
        for evaluation in self.evaluations.values():
            for name, value in cells_of(evaluation).items():
                columns.setdefault(name, []).append(value)
        return frame(columns, "filter")

    def check_consistency(self) -> ConsistencyReport:
        """Compare the filter's errors and innovations with its own covariances: NEES, NIS, whiteness, coverage."""
        return check_consistency(self.filter, self.problem.data(self.seeds), self.problem.dt)

    def plot_errors(self) -> Figure:
        """RMSE of each state, of all filters, with 95 % intervals and the bound.

        Raises:
            ValueError: without truth, since there is no RMSE.
        """
        from tuning.reporting.search_figures import draw_comparison

        name = self.choice.name
        return drawn(draw_comparison(self.comparison, f"{label_of(name)} on {self.problem.name}", name))

    def plot_run(self, run: int = 0) -> Figure:
        """One held-out run over time, of the first baseline and the filter: truth, estimate and 95 % band.

        Args:
            run: its number among the held-out seeds, from 0.
        """
        from tuning.reporting.time_figures import draw_estimates

        run = at_least("run", run, 0, len(self.seeds) - 1)
        pair = {RULE: self.choice}
        if self.is_tuned:
            choices = {name: choice for name, choice in self.choices.items() if name != self.name}
            first = self.comparison.baselines[0]
            pair = {first: choices[first], self.name: self.choice}
        filters = {name: choice.filter(self.problem) for name, choice in pair.items()}
        data, scored = self.problem.data(self.seeds), self.evaluation.scored or None
        return drawn(draw_estimates(filters, data, run, self.problem.dt, scored))

    def plot_consistency(self) -> Figure:
        """The checks of `check_consistency`, a panel each.

        Raises:
            ValueError: for a filter without a covariance.
        """
        from tuning.reporting.search_figures import draw_consistency

        title = f"{label_of(self.choice.name)} on {len(self.seeds)} seeds of {self.problem.name}"
        scored = self.evaluation.scored or None
        report, name = self.check_consistency(), self.choice.name
        return drawn(draw_consistency(report, title, scored=scored, filter_name=name))

    def __repr__(self) -> str:
        seeds = f"{len(self.seeds)} held-out {self.problem.seed_word}"
        what = f"{label_of(self.choice.name)} on {self.problem.name}, {seeds}"
        if not self.evaluation.has_truth:
            return f"HeldOut({what}: log-likelihood of a run {number(self.evaluation.log_likelihood)})"
        ratios = [f"{about(ratio)} x {name}" for name, ratio in self.ratios.items()][: int(self.is_tuned)]
        return f"HeldOut({', '.join([f'{what}: score {about(self.score)}', *ratios])})"

    def numbers_and_errors(self) -> list[Table]:
        """The parameters of each filter, and its errors."""
        where = f"held-out {self.problem.seed_word} {self.seeds.start} to {self.seeds.stop - 1}"
        where = f"{where}, scenario {self.problem.name}"
        errors = comparison_table(self.evaluations, self.bound, where, self.problem.scale_about)
        return [choice_table(self.choices, self.problem), errors]

    def tables(self) -> list[Table | str]:
        """The choice, the parameters, the errors, the gain of tuning and the residuals."""
        checked = [] if self.covariance is None else self.covariance.lines()
        words = [*self.sentences(), *residual_sentences(self.problem, self.seed), *checked]
        return [*self.chosen, *self.numbers_and_errors(), *words]

    def figures(self) -> dict[str, Figure]:
        """Errors and one run over time; whether the covariance is consistent, if there is one."""
        figures = {"One run over time": self.plot_run()}
        if self.evaluation.has_truth:
            figures |= {"Errors with 95 % intervals": self.plot_errors()}
        if self.filter.has_covariance:
            figures |= {"Is the covariance consistent?": self.plot_consistency()}
        return figures

    def sentences(self) -> list[str]:
        """The gain of tuning over each baseline; for an untuned filter a description of the scaled default."""
        restarts = restart_sentences(self.evaluations)
        if not self.chosen:  # a study's sentences have them
            restarts += warnings_of(self.evaluation, self.problem, self.forget)
        restarts.append(memory_sentence(self.evaluation, self.problem))
        if self.is_tuned:
            sentences = gains(self.comparison, self.problem.seed_word, self.name)
            return [*sentences, *model_doubts(self.problem, self.comparison, self.seed), *restarts]
        truth = [] if self.evaluation.has_truth else [without_truth(self.problem.name)]
        return [*truth, scaling_sentence(self.comparison), *restarts]


def comparison_sentence(name: str, first: str, second: str, ratio: Interval) -> str:
    """One state's RMSE of two filters on the same runs, from a ratio of `intervals.rmse_ratios`."""
    verdict = f"{first} is better" if ratio.high < 1 else f"{second} is better" if ratio.low > 1 else "a tie"
    return f"RMSE of {name}, {first} over {second} on the same runs: {span(ratio)}: {verdict}."


@dataclass(frozen=True, eq=False, repr=False)
class CovarianceCheck:
    """Whether a filter's covariance is consistent, with a picture of the checks.

    Attributes:
        label: of the filter among its baselines.
        report: NEES, NIS, whiteness, coverage and CRPS.
        over_true: RMSE of each state over the oracle's, if there is one.
        picture: path of the file.
    """

    label: str
    report: ConsistencyReport
    over_true: Sequence[Interval] | None
    picture: str

    def sentences(self) -> list[str]:
        """A sentence on each check, and on the errors over the oracle's."""
        parts = sentences(self.report)
        if self.over_true is not None:
            pairs = list(zip(self.report.states, self.over_true, strict=True))
            parts += [
                comparison_sentence(state, self.label, ORACLE, ratio) for state, ratio in pairs[:MOST_STATES]
            ]
            if len(pairs) > MOST_STATES:
                parts.append(f"Of {len(pairs)} states these are the first {MOST_STATES}.")
        return parts

    def lines(self) -> list[str]:
        """The same for a terminal."""
        return [f"Is the {self.label} filter consistent?", *self.sentences(), f"Picture: {self.picture}"]

    def as_dict(self) -> dict[str, Any]:
        """The numbers by name."""
        report, white, ensemble = self.report, self.report.whiteness, self.report.ensemble
        members = None
        if ensemble is not None:
            ranks = [{"frequencies": rank.frequencies, "p_value": rank.p_value} for rank in ensemble.ranks]
            members = {"size": ensemble.size, "ranks": ranks, "crps": ensemble.crps}
        return {
            "states": report.states,
            "nees": _of_squares(report.nees),
            "nis": _of_squares(report.nis),
            "innovations": {
                "correlations": white.correlations,
                "statistic": white.statistic,
                "p_value": white.p_value,
            },
            "coverage_95": report.coverage,
            "crps": report.crps,
            "crps_expected": report.crps_expected,
            "members": members,
            "channels": report.channels,
            "innovation_coverage_95": report.innovation_coverage,
            "divergences": report.divergences,
            "rmse_over_true": self.over_true,
            "sentences": self.sentences(),
            "picture": self.picture,
        }


def _of_squares(check: SquaresCheck) -> dict[str, Any]:
    return {
        "mean": check.mean,
        "right": check.dimension,
        "share_of_steps_in_95_band": check.share_inside,
        "share_beyond_95_point": check.beyond,
        "distance_from_chi_square": check.distribution.distance,
        "p_value": check.distribution.p_value,
    }


def cells_of(evaluation: Evaluation) -> dict[str, float]:
    """The results of an evaluation by column names."""
    pairs = zip(evaluation.states, evaluation.rmse, strict=True)
    intervals = {f"RMSE {state.short_label}": rmse for state, rmse in pairs}
    for symbol, rmse in evaluation.output_rmse.items():
        intervals[f"RMSE {evaluation.outputs[symbol].short_label}"] = rmse
    intervals |= {"score": evaluation.score, "log score": evaluation.log_score}
    intervals |= {"NEES": evaluation.nees, "NIS": evaluation.nis}
    cells = {
        key: value for name, part in intervals.items() for key, value in cells_of_interval(name, part).items()
    }
    return cells | {"log-likelihood": evaluation.log_likelihood, "restarts": evaluation.divergences}


def cells_of_interval(name: str, value: Interval) -> dict[str, float]:
    """A value and its ends by column names."""
    return {name: value.value, f"{name} low": value.low, f"{name} high": value.high}
