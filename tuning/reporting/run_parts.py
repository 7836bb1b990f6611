"""Sections of a report on one run over time: estimates, measurements, innovations, gain, consistency."""

from __future__ import annotations

import numpy as np

from filters.consistency.verdicts import sentences
from filters.registry import filter_type
from thruster_env.core.sources import is_array
from tuning.evaluation.baselines import TUNED, baseline_size, baselines
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
    "Limits are those of the scored steps, the same in a row unless its panels say otherwise; RMSE and RMS "
    "are over these steps."
)
READ = "Point at a figure to read values; drag sideways to zoom in, double-click to zoom out."


def run_sections(book: Sketchbook, subject: Subject, comparison: Comparison) -> list[Section]:
    """One held-out run over time, and whether the covariance is consistent, both on the first scenario."""
    choice, scenario = subject.choice, subject.plan.scenarios[0]
    data, tuned = scenario.data(comparison.seeds), choice.filter(scenario)
    size = baseline_size(choice)
    known = baselines(choice.name, scenario, subject.plan.seed, comparison.default, size)
    name, before = next(iter(known.items()))
    pair, dt = {name: before.filter(scenario), TUNED: tuned}, scenario.dt
    word = scenario.seed_word.removesuffix("s")
    where = f"{scenario.name}, held-out {word} {comparison.seeds.start}"
    has_covariance, scored = filter_type(choice.name).has_covariance, comparison.tuned.scored or None
    what = "Estimate and innovation, each with its" if data.states is None else "Truth, estimate and"
    caption = f"{what} 95 % band on {where}, before and after. {AXES} {READ}"
    alt = of_estimates(pair, data, 0, dt)
    remark = [] if data.states is not None else [Words([f"{scenario.name} has no truth, so there are no errors."])]
    picture = book.picture(draw_estimates(pair, data, 0, dt, scored), caption, alt)
    sections = [Section("One run over time", [picture, *remark])]
    model = tuned.model
    named = [one.name for one in model.measurements], [one.unit for one in model.measurements]
    alt = f"Measured: {of_series(named[0], data.one(0).measurements[0], named[1])}"
    caption = f"Measurements on {where}, their prediction by the tuned filter before each update, and the inputs."
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
    report = check_consistency(tuned, data, dt)
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
    "NEES, the normalised estimation error squared, relates the error to the filter's covariance: if the "
    "covariance is right, its mean is the number of states. NIS, the normalised innovation squared, does the "
    "same with the innovation: its mean is the number of channels. CRPS, the continuous ranked probability "
    "score, is the error of a whole distribution, in the unit of the state."
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
        f"Gain K on {where}: the change of each state per unit of innovation, before and after tuning. It "
        "is computed from the covariance after the update, K = P H' inv(R), with H at the estimate. Each "
        "panel has its own axis."
    )
    picture = book.picture(draw_gains(pair, data, 0, dt, scored), caption, f"Gain over time. {'. '.join(told)}.")
    return Section("Gain over time", [picture])
