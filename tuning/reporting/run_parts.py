"""What stands in a report on one run over time: estimates, what was measured, innovations, gain, consistency."""

from __future__ import annotations

import numpy as np

from filters.consistency.verdicts import sentences
from filters.registry import filter_class
from numerics.sources import is_array
from tuning.evaluation.baselines import TUNED, baselines
from tuning.evaluation.evaluate import check_consistency
from tuning.evaluation.held_out import Comparison
from tuning.reporting.alternatives import of_estimates, of_series
from tuning.reporting.consistency_figures import draw_consistency
from tuning.reporting.page import Part, Section, Words
from tuning.reporting.signal_figures import draw_gains, draw_innovations, draw_signal, gains
from tuning.reporting.sketchbook import Sketchbook
from tuning.reporting.subject import Subject
from tuning.reporting.time_figures import draw_estimates

AXES = (
    "Limits are those of the scored steps, the same in a row unless its panels say that their axes differ; RMSE "
    "and RMS are over these steps."
)
READ = "Values are read off under the pointer; drag sideways to enlarge a stretch, double-click for all of it."


def run_sections(book: Sketchbook, subject: Subject, proof: Comparison) -> list[Section]:
    """One held-out run over time, and whether the covariance is consistent, both on the first scenario."""
    choice, scenario = subject.choice, subject.plan.scenarios[0]
    data, tuned = scenario.data(proof.seeds), choice.filter(scenario)
    name, before = next(iter(baselines(choice.name, scenario, subject.plan.seed, proof.default).items()))
    pair, dt = {proof.label(name): before.filter(scenario), TUNED: tuned}, scenario.dt
    word = scenario.seed_word.removesuffix("s")
    where = f"{scenario.name}, held-out {word} {proof.seeds.start}"
    has_covariance, scored = filter_class(choice.name).has_covariance, proof.tuned.scored or None
    what = "Estimate and innovation, each with its" if data.states is None else "Truth, estimate and"
    caption = f"{what} 95 % band on {where}, before and after. {AXES} {READ}"
    alt = of_estimates(pair, data, 0, dt)
    remark = [] if data.states is not None else [Words([f"{scenario.name} has no truth, so there are no errors."])]
    picture = book.picture(draw_estimates(pair, data, 0, dt, scored), caption, alt)
    sections = [Section("One run over time", [picture, *remark])]
    model = tuned.model
    named = [one.name for one in model.measurements], [one.unit for one in model.measurements]
    alt = f"Measured: {of_series(named[0], data.measurements[0], named[1])}"
    caption = (
        f"What was measured on {where}, what the tuned filter expected of it before each update, and the inputs."
    )
    sections.append(Section("Measured signal", [book.picture(draw_signal(tuned, data, 0, dt), caption, alt)]))
    if not has_covariance:
        return sections
    if data.states is not None:
        without = data._replace(states=None, outputs=None)
        caption = (
            f"Innovations on {where}, each in the 95 % band that the filter expects, before and after. {AXES}"
        )
        picture = book.picture(draw_innovations(pair, data, 0, dt), caption, of_estimates(pair, without, 0, dt))
        sections.append(Section("Innovations", [picture]))
    if not is_array(model.n, model.m):
        sections.append(_gain_section(book, pair, data, dt, scored, where))
    report = check_consistency(tuned, data)
    said = sentences(report)
    runs = f"{report.runs} held-out {scenario.seed_word} of {scenario.name}"
    drawn = draw_consistency(report, f"{choice.name}, tuned, on {runs}", scored=scored, filter_name=choice.name)
    parts: list[Part] = [
        Words([NEES_NIS]),
        Words(said),
        book.picture(drawn, f"Checks of the tuned filter's covariance on {runs}.", " ".join(said)),
    ]
    return [*sections, Section("Is the covariance consistent?", parts)]


NEES_NIS = (
    "NEES, the normalised estimation error squared, holds the error against the filter's covariance: on average "
    "it is the number of states where the covariance is right. NIS, the normalised innovation squared, does so "
    "with the innovation: it is the number of channels. CRPS, the continuous ranked probability score, is the "
    "error of a whole distribution, in the unit of the state."
)


def _gain_section(book: Sketchbook, pair, data, dt, scored, where: str) -> Section:
    """The gain over time, before and after."""
    told = []
    for title, filter_ in pair.items():
        found, model = gains(filter_, data, 0), filter_.model
        last = [matrix for matrix in found if np.isfinite(matrix).all()]
        if last:
            values = ", ".join(
                f"{state.text_symbol} by {channel.text_symbol} {last[-1][i, j]:.3g}"
                for i, state in enumerate(model.states)
                for j, channel in enumerate(model.measurements)
            )
            told.append(f"{title}: {values} at the end")
    caption = (
        f"Gain K on {where}: by how much an innovation of one unit moves each state, before and after tuning. It "
        "is that of the covariance after the update, K = P H' inv(R), with H at the estimate. Each panel has an "
        "axis of its own."
    )
    picture = book.picture(draw_gains(pair, data, 0, dt, scored), caption, f"Gain over time. {'. '.join(told)}.")
    return Section("Gain over time", [picture])
