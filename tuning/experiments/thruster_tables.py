"""Both papers on the bow thruster beside ours: tables, statements, a picture, and the command.

The papers compare a Kalman filter (KF) with an ensemble Kalman filter (EnKF) by the RMSE of one run, it seems.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from filters import EnsembleKalmanFilter, KalmanFilter
from filters.engine.batch import run
from filters.ensembles.ensemble import LARGEST_ENSEMBLE
from filters.logs.findings import TRUTH, plot_style
from thruster_env.core.checks import at_least
from thruster_env.core.files import new_figure, save_figure, tidy
from thruster_env.core.text_tables import Table
from thruster_env.logs.write import check_picture
from thruster_env.model.simulate import simulate
from thruster_env.thruster.analysis import STATES
from thruster_env.thruster.linear import SAMPLE_TIME
from tuning.api.markers import FILTER, OUTPUT, WRITTEN, Option, PythonOnly, Seed
from tuning.api.markers import RUNS as RUNS_PANEL
from tuning.api.result import Printed
from tuning.cli.output import progress_of
from tuning.experiments.thruster_papers import (
    EQUAL,
    MEMBERS,
    MOST_RUNS,
    NOISE_LEVELS,
    RUNS,
    STEPS,
    STUDIES,
    SYSTEMS,
    UNSEEN_RATIO,
    Comparison,
    Finding,
    PublishedTable,
    compare_all,
    discrete_model,
    findings,
    keys_of,
)

STYLES = {
    "truth": TRUTH,
    "KF": plot_style("kf") | {"linewidth": 1.2},
    "EnKF": plot_style("enkf") | {"linewidth": 1.2, "linestyle": (0, (3, 2))},  # in whose gaps the other is seen
}
LINES = "In each cell first omega_m [rad/s], below it U_a [m/s]."


def general_statements(comparisons: list[Comparison]) -> list[str]:
    """Statements on our runs that do not depend on a paper."""
    ratios = np.array([c.enkf_over_kf for c in comparisons])
    scatter = 100 * np.array([c.kf.run_std / c.kf.rmse for c in comparisons])
    covered = np.array([(c.kf.low <= c.optimum) & (c.optimum <= c.kf.high) for c in comparisons])
    start = 100 * np.abs([c.kf_identity.rmse / c.kf.rmse - 1.0 for c in comparisons])
    return [
        "On a linear Gaussian model the Kalman filter (KF) is optimal, and the ensemble Kalman filter (EnKF) "
        "tends to it as the ensemble grows. So the EnKF cannot beat the KF: they tie at the "
        f"Riccati value. Here EnKF/KF lies between {ratios.min():.3f} and {ratios.max():.3f}.",
        f"The KF's 95 % interval covers the Riccati optimum in {covered.sum()} of {covered.size} cells; one "
        "in twenty may miss it by chance.",
        f"The RMSE of a single run of {STEPS} steps scatters by {scatter.min():.0f} to {scatter.max():.0f} % "
        "(standard deviation), so the papers' single run, as it seems, decides nothing.",
        f"Starting from P_0 = I changes the KF's RMSE by {start.max():.2f} % at most. With P_0 = P_inf and "
        "Q = R = q I every error is proportional to sqrt(q): the four noise levels are one experiment, done "
        "here four times with other draws.",
        "The un-updated ensemble: the members run free, the gain comes from their covariance, only the mean "
        "is corrected, and the measurements carry no noise, so its U_a in the tunnel case can fall below "
        "the optimum. On the unstable open-bladed system the members' covariance grows without limit, and the "
        "gain follows it.",
    ]


def study_statements(table: PublishedTable, findings_: list[Finding]) -> list[str]:
    """Statements that compare a paper's columns with ours, and the remarks on the paper."""
    tunnel, open_bladed = (
        [f for f in findings_ if f.filter == "enkf" and f.case == case] for case in ("tunnel", "open-bladed")
    )
    clean = [f for f in tunnel + open_bladed if not f.published.note]
    unseen = sum(abs(f.published.omega_m / f.published.U_a / UNSEEN_RATIO - 1.0) < 0.01 for f in clean)
    right, right_std = np.mean([f.ours.run_ratio for f in clean], axis=0)
    kalman = [f for f in findings_ if f.filter == "kf"]
    equal, as_printed = (
        sum(abs(omega_m / flow - 1.0) < EQUAL for omega_m, flow in pairs)
        for pairs in ([f.published.meant for f in kalman], [f.published[:2] for f in kalman])
    )
    corrected = "" if equal == as_printed else f" ({as_printed} by the table, which the text corrects)"
    above = ", ".join(
        f"{_span([f for f in kalman if f.case == case], state=1)} times in the {case} case"
        for case in dict.fromkeys(f.case for f in kalman)
    )
    return [
        "The published EnKF column of the tunnel is the optimum, within the scatter of one run: its values "
        f"are within {_farthest(tunnel, 'from_optimum'):.1f} standard deviations of it.",
        f"The published EnKF column of the open-bladed case is {_span(open_bladed)} times the optimum. Its "
        f"values are within {_farthest(open_bladed, 'from_unupdated'):.1f} standard deviations of the "
        "un-updated ensemble. That is an inference from the numbers, not from the paper's text.",
        f"In {unseen} of {len(clean)} EnKF cells, both cases taken together, the error of omega_m over that "
        f"of U_a is within 1 % of {UNSEEN_RATIO:.2f} = 12.2/2.03. Errors in this ratio are those that H does "
        "not see, and about all that measurements without noise leave. A right filter with noisy ones "
        f"gives {right:.2f} +- {right_std:.2f} in a single run. So the published measurements seem to be "
        "noise-free, the tunnel's too.",
        f"The published KF column has errors equal in both states to {100 * EQUAL:.0f} % in {equal} of "
        f"{len(kalman)} rows{corrected}, and in U_a exceeds the optimum {above}. "
        "No mechanism for it is known to us.",
        *table.remarks,
    ]


def _farthest(results: list[Finding], distance: str) -> float:
    # A cell with a note is not a value of its row: a copied one belongs to another q.
    return max(float(np.abs(getattr(f, distance)).max()) for f in results if not f.published.note)


def _span(results: list[Finding], state: int | None = None) -> str:
    factors = np.array([f.over_optimum if state is None else f.over_optimum[state] for f in results])
    return f"{factors.min():.1f} to {factors.max():.1f}"


class Series(NamedTuple):
    """The first run of a comparison; states are (omega_m [rad/s], U_a [m/s])."""

    case: str
    q: float
    time: np.ndarray  # (101,) [s]
    measurements: np.ndarray  # (101, 1) [N]
    truth: np.ndarray  # (101, 2)
    kf: np.ndarray  # (101, 2)
    enkf: np.ndarray  # (101, 2)

    def rmse(self, filter_: str) -> np.ndarray:
        """RMSE (2,) over steps 1 to 100 of "kf" or "enkf", as in the papers' tables."""
        errors = getattr(self, filter_) - self.truth
        return np.sqrt((errors[1:] ** 2).mean(axis=0))


def series(case: str, q: float, *, members: int = MEMBERS, seed: int = 0) -> Series:
    """The first of the runs that `comparison.compare` makes with the same seed; its arguments and errors."""
    members, seed = at_least("members", members, 2, LARGEST_ENSEMBLE), at_least("seed", seed, 0)
    model = discrete_model(case, q)
    keys, _ = keys_of(case, q, 1, seed)
    inputs = np.zeros((1, STEPS, model.inputs))
    truth = simulate(model, keys, inputs)
    kf, enkf = (
        run(filter_, keys, inputs, truth.measurements).means[0]
        for filter_ in (KalmanFilter(model=model), EnsembleKalmanFilter(model=model, ensemble_size=members))
    )
    time = SAMPLE_TIME * np.arange(STEPS + 1)
    return Series(case, q, time, truth.measurements[0], truth.states[0], kf, enkf)


def all_series(*, members: int = MEMBERS, seed: int = 0) -> list[Series]:
    """`series` for every case and noise level, in the order of `compare_all`."""
    return [series(case, q, members=members, seed=seed) for case in SYSTEMS for q in NOISE_LEVELS]


def series_figure(path: str | Path, runs: list[Series], members: int) -> Path:
    """Truth, KF and EnKF over time as PNG: a column for each noise level, a row for each case and state."""
    cases = list(dict.fromkeys(simulated.case for simulated in runs))
    levels = list(dict.fromkeys(simulated.q for simulated in runs))
    figure = new_figure((3.3 * len(levels) + 0.6, 2.15 * 2 * len(cases) + 0.6))
    axes = figure.subplots(2 * len(cases), len(levels), sharex=True, sharey="row", squeeze=False)
    tidy(axes.flat)
    for simulated in runs:
        first, column = 2 * cases.index(simulated.case), levels.index(simulated.q)
        errors = simulated.rmse("kf"), simulated.rmse("enkf")
        for state, (label, unit) in enumerate(STATES):
            axis = axes[first + state, column]
            drawn = simulated.truth, simulated.kf, simulated.enkf
            for (name, line), values in zip(STYLES.items(), drawn, strict=True):
                axis.plot(simulated.time, values[:, state], label=name, **line)
            text = f"RMSE: KF {errors[0][state]:.3f}, EnKF {errors[1][state]:.3f} {unit}"
            axis.set_title(f"q = {simulated.q:g}\n{text}" if first + state == 0 else text, fontsize=9)
            if column == 0:
                axis.set_ylabel(f"{simulated.case}\n{label}\n[{unit}]")
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    figure.align_ylabels(axes[:, 0])
    handles, labels = axes[0, 0].get_legend_handles_labels()
    labels = [f"{name}, {members} members" if name == "EnKF" else name for name in labels]
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle("One run of the published linear systems, Q = R = q I", fontsize=11)
    return save_figure(figure, path)


def own_table(case: str, comparisons: list[Comparison], runs: int, members: int) -> Table:
    """All estimators on one case, a row a noise level and start."""
    rows = []
    for c in comparisons:
        for start, kf, enkf in (("P_inf", c.kf, c.enkf), ("I", c.kf_identity, c.enkf_identity)):
            ratio = _lines(enkf.rmse / kf.rmse, ".3f")
            rows.append([f"{c.q:g}", start, _lines(c.optimum), _intervals(kf), _intervals(enkf), ratio])
    columns = ["q", "P_0", "Riccati optimum", "KF, 95 % interval", "EnKF, 95 % interval", "EnKF / KF"]
    title = f"{case}: RMSE of {runs} runs of 100 steps, EnKF with {members} members"
    caption = f"{LINES} P_0: covariance of x_0 and of the filter's prior."
    return Table(title, columns, rows, caption=caption)


def published_table(name: str, case: str, results: list[Finding]) -> Table:
    """A paper's values on one case beside ours."""
    rows = []
    for f in results:
        free = f.from_unupdated is not None
        rows.append(
            [
                f"{f.q:g}",
                "EnKF" if f.filter == "enkf" else "KF",
                _lines(f.published[:2]),
                _lines(f.ours.rmse),
                _distances(f.optimum, f.from_optimum),
                _distances(f.unupdated.rmse, f.from_unupdated) if free else "",
                f.why,
            ]
        )
    why = "why they differ"
    columns = ["q", "filter", "published", "ours", "optimum (sd)", "un-updated ensemble (sd)", why]
    caption = (
        f"{LINES} (sd): distance of the published value above ours, in standard deviations of a single run's "
        "RMSE. Un-updated ensemble: a wrong filter, see below."
    )
    return Table(f"{name}, {case}: published RMSE against ours", columns, rows, caption=caption, words=[why])


def _lines(values, form: str = ".4f") -> str:
    return "\n".join(format(value, form) for value in values)


def _intervals(score) -> str:
    return "\n".join(
        f"{rmse:.4f} [{low:.4f}, {high:.4f}]"
        for rmse, low, high in zip(score.rmse, score.low, score.high, strict=True)
    )


def _distances(centre, distances) -> str:
    return "\n".join(
        f"{value:.4f} ({round(sd, 1) + 0.0:+.1f})" for value, sd in zip(centre, distances, strict=True)
    )


def _plain_comparison(c) -> dict:
    return {name: v._asdict() if hasattr(v, "_asdict") else v for name, v in c._asdict().items()} | {
        "enkf_over_kf": c.enkf_over_kf
    }


def _plain_finding(f) -> dict:
    return {
        "case": f.case,
        "q": f.q,
        "filter": f.filter,
        "published": list(f.published[:2]),
        "note": f.published.note,
        "in_text": f.published.in_text,
        "sd_from_optimum": f.from_optimum,
        "sd_from_unupdated": f.from_unupdated,
        "published_over_optimum": f.over_optimum,
        "why": f.why,
    }


def reproduce(
    name: Annotated[str, PythonOnly()],
    runs: Annotated[int, Option(RUNS_PANEL)] = RUNS,
    members: Annotated[int, Option(FILTER)] = MEMBERS,
    series: Annotated[Path | None, Option(OUTPUT, metavar="FILE", file=WRITTEN)] = None,
    seed: Seed = 0,
) -> Printed:
    """Repeat the papers on the bow thruster many times and say why their tables differ from ours.

    The papers compare a Kalman filter (KF) with an ensemble Kalman filter
    (EnKF) on two linear bow thrusters, tunnel and open-bladed, at Q = R = q I
    for four values of q, apparently by the RMSE of one run.

    Here both filters see the same runs. Three more columns show what to expect: the Riccati optimum, which no
    filter can beat; the start from P_0 = I; and a wrong filter, whose ensemble is never updated, which gives the
    published open-bladed EnKF. Every published value comes with its distance in standard deviations of a single
    run, and the reason for the difference.

    Example: thruster reproduce nurhadi2022 --series series.png --json table.json

    Args:
        name: the paper, or both.
        runs: independent runs of 100 steps, at least 2; few make wide intervals.
        members: ensemble size N of the papers' EnKF, at least 2.
        series: also draw one run over time for each system and q, as the papers do: .png, .svg or .pdf; into
            --json, too.
        seed: seed of all randomness; the same seed gives the same results.
    """
    if series is not None:
        check_picture(series, "--series")
    runs = at_least("runs", runs, 2, MOST_RUNS)
    with progress_of(f"{runs} runs of each case and noise level") as progress:
        comparisons = compare_all(
            runs=runs, members=members, seed=seed, on_progress=lambda done, total: progress("", done, total)
        )
    by_case = {case: [c for c in comparisons if c.case == case] for case in SYSTEMS}
    output: list[Any] = [own_table(case, of_case, runs, members) for case, of_case in by_case.items()]
    general = general_statements(comparisons)
    studies: dict[str, Any] = {}
    data = {
        "settings": {"runs": runs, "members": members, "seed": seed},
        "states": ["omega_m [rad/s]", "U_a [m/s]"],
        "results": [_plain_comparison(c) for c in comparisons],
        "studies": studies,
        "statements": general,
    }
    for paper in [STUDIES[name]] if name in STUDIES else STUDIES.values():
        rows = findings(paper, comparisons)
        output += [published_table(paper.name, case, [f for f in rows if f.case == case]) for case in by_case]
        statements = study_statements(paper, rows)
        output += [f"{paper.name}: {paper.source}", *(f"- {statement}" for statement in statements)]
        studies[paper.name] = {
            "source": paper.source,
            "rows": [_plain_finding(f) for f in rows],
            "statements": statements,
        }
    output += ["Conclusions from the runs", *(f"- {statement}" for statement in general)]
    if series is not None:
        drawn = all_series(members=members, seed=seed)
        output.append(f"Picture: {series_figure(series, drawn, members)}")
        data |= {"series": [run._asdict() for run in drawn], "picture": str(series)}
    return Printed(output, data)
