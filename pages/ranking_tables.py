"""Make the tables of docs/ranking.md: which filter beats which where, on held-out seeds.

    python -m pages.ranking_tables [PAGE] [--table NAME]...

The tables between the comments `<!-- table NAME -->` and `<!-- end -->` of PAGE, docs/ranking.md by default, are
written anew; all of them take some twenty minutes on two cores. Every run gives the same, but for times.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from filters.consistency.intervals import Interval
from filters.registry import FILTERS, filter_type
from pages.page import DOCS, digits
from thruster_env.core.files import write_whole
from thruster_env.core.text_tables import markdown_table, with_tables
from tuning.evaluation.compare import Contender, Leaderboard, Row, compare, contender
from tuning.problems.excitation import Steps
from tuning.problems.find import find_problem
from tuning.problems.problem import Problem
from tuning.problems.seeds import held_out_seeds
from tuning.reporting.error_tables import unless_blank
from tuning.search.parameters import KALMAN_SIZES, ensemble_sizes_of
from tuning.thruster.scenario import SCENARIOS, find_scenario

SEEDS = 200
REFERENCE_SEEDS, REFERENCE_SIZE = 20, 100_000
EKF, ROBUST, IMM, IEKF, UKF, GSF = map(contender, ("ekf", "ekf-robust", "imm", "iekf", "ukf", "gsf"))
PF, MANY = contender("pf"), contender("pf", ensemble_size=5000)
ENKF, IENKF = (contender(name, ensemble_size=100) for name in ("enkf", "ienkf"))
SMALL = contender("enkf", ensemble_size=30)
INFLATED, SMALL_INFLATED = (contender("enkf", ensemble_size=size, inflation=1.1) for size in (100, 30))
IENKF_INFLATED = contender("ienkf", ensemble_size=100, inflation=1.1)
RANKED = contender("rhf", ensemble_size=100)
SMALL_FINITE = contender("enkf-n", ensemble_size=30)
SMALL_ADAPTIVE, SMALL_RESTING = (
    contender("enkf", ensemble_size=30, adaptive_inflation=0.1, least_deviation=least) for least in (None, 0.02)
)
FLOW = {"ambient_velocity": None}
DISCUSSED = "nominal published_noise outliers deadband mismatch ambient startup speed_magnitude".split()
VEHICLE, VEHICLE_SEEDS = ("auv:motion", "auv:dvl_outliers", "auv:wrong_drag"), 50
COLUMNS = ("omega_m [rad/s]", "over {0}", "U_a [m/s]", "over {0}", "NEES", "NIS", "log L")


def speed() -> str:
    """|speed| at slow crossings and dwells."""
    by_speed = contender("gsf", component=0)  # the sum is split along omega_m
    marginal = [contender("rbpf", sampled=(component,)) for component in (0, 1)]
    filters = [EKF, UKF, by_speed, ENKF, RANKED, PF, MANY, *marginal]
    return table_of(leaderboard(find_scenario("speed_magnitude"), filters))


def fast() -> str:
    """|speed| at fast reversals."""
    slow = find_scenario("speed_magnitude")
    scenario = slow.replace(name="fast_reversals", excitation=Steps(12.0), measurement_noise_cov=25.0)
    return table_of(leaderboard(scenario, [EKF, UKF, MANY]))


def outliers() -> str:
    """Outliers in the thrust."""
    return table_of(leaderboard(find_scenario("outliers"), [EKF, ROBUST, IMM, ENKF, PF]))


def ambient() -> str:
    """A flow that the filter does not know, and filters that estimate it."""
    joint = [contender("ekf", unknown=FLOW), contender("enkf", unknown=FLOW, ensemble_size=100)]
    return table_of(leaderboard(find_scenario("ambient"), [EKF, joint[0], ENKF, joint[1]]))


def published() -> str:
    """The published noise."""
    ensembles = [SMALL, SMALL_INFLATED, SMALL_ADAPTIVE, SMALL_RESTING, SMALL_FINITE]
    ensembles += [ENKF, INFLATED, IENKF, IENKF_INFLATED]
    particles = [
        contender("pf", proposal="optimal"),
        contender("pf", resampling="gaussian", resampling_threshold=1.0),
    ]
    particles.append(contender("rbpf", sampled=(1,)))  # U_a
    filters = [EKF, IEKF, UKF, *ensembles, GSF, PF, MANY, *particles]
    return table_of(leaderboard(find_scenario("published_noise"), filters))


def reference() -> str:
    """The published noise, beside a particle filter with so many particles that more change nothing."""
    best = contender("pf", ensemble_size=REFERENCE_SIZE)
    filters = [best, EKF, IEKF, UKF, ENKF, IENKF, GSF, PF, MANY]
    return table_of(leaderboard(find_scenario("published_noise"), filters, REFERENCE_SEEDS))


def startup() -> str:
    """RMSE of the first 50 steps from an unknown state."""
    lines = ["| filter | omega_m [rad/s] | U_a [m/s] |", "|---|---|---|"]
    for row in leaderboard(find_scenario("startup"), [EKF, IEKF, UKF, ENKF, GSF, PF]).rows:
        speed_error, flow_error = row.evaluation.start_up_rmse
        lines.append(f"| {row.label} | {speed_error:.1f} | {flow_error:.3f} |")
    return "\n".join(lines)


def scores() -> str:
    """Scores over that of the EKF, a row per scenario."""
    filters = [EKF, ROBUST, IMM, IEKF, UKF, ENKF, GSF, PF]
    boards = [leaderboard(scenario, filters) for scenario in SCENARIOS.values()]
    labels = [filter_.label for filter_ in filters[1:]]
    lines = [f"| scenario | ekf: score | {' | '.join(labels)} |", "|---" * (len(labels) + 2) + "|"]
    for board in boards:
        first, *rest = board.rows
        cells = [f"`{board.scenario.name}`", f"{first.evaluation.score.value:.2f}", *map(ratio_cell, rest)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def every_filter() -> str:
    """Scores over that of the EKF, a row per filter."""
    return ratios_of([*map(by_default, FILTERS)], [*DISCUSSED, *VEHICLE])


def by_default(name: str) -> Contender:
    """A filter with its default parameters, but an ensemble of 100, and Schmidt's with the flow considered."""
    if name == "schmidt":
        return contender(name, unknown=FLOW, considered=(-1,))._replace(label="schmidt, U_0 considered")
    sized = filter_type(name).has_ensemble and ensemble_sizes_of(filter_type(name)) == KALMAN_SIZES
    return contender(name, ensemble_size=100 if sized else None)


def ratios_of(filters: Sequence[Contender], problems: Sequence[str]) -> str:
    """Scores and times over the EKF's, by problem and as a median; a dash where a filter refuses the model."""
    cells: dict[str, list[str]] = {filter_.label: [] for filter_ in (EKF, *filters)}
    times: dict[str, list[float]] = {label: [] for label in cells}
    for problem in map(find_problem, problems):
        accepted = [filter_ for filter_ in filters if filter_.label != EKF.label and _accepts(filter_, problem)]
        seeds = VEHICLE_SEEDS if problem.name in VEHICLE else SEEDS
        first, *rest = leaderboard(problem, [EKF, *accepted], seeds).rows
        cell_of = {row.label: ratio_cell(row) for row in rest}
        cell_of[first.label] = f"{first.evaluation.score.value:.2f}"
        for label, line in cells.items():
            line.append(cell_of.get(label, "-"))
        for row in (first, *rest):
            times[row.label].append(row.microseconds / first.microseconds)
    header = ["filter", *(re.sub("[_:]", " ", name) for name in problems), "time"]
    return markdown_table(header, [[label, *line, _median_of(times[label])] for label, line in cells.items()])


def _median_of(ratios: Sequence[float]) -> str:
    return digits(np.median(ratios), 1) if ratios else "-"


def _accepts(filter_: Contender, problem: Problem) -> bool:
    try:
        filter_.filter(problem)
    except ValueError:
        return False
    return True


def scenarios() -> str:
    """What each scenario is."""
    lines = ["| scenario | what it is | excitation | scale |", "|---|---|---|---|"]
    for scenario in SCENARIOS.values():
        arguments = [f"{key} {value}" for key, value in scenario.excitation.as_mapping().items() if key != "name"]
        excitation = f"`{scenario.excitation.name}`: {', '.join(arguments)}"
        speed_scale, flow_scale = scenario.scale
        lines.append(
            f"| `{scenario.name}` | {scenario.about} | {excitation} | {speed_scale} rad/s, {flow_scale} m/s |"
        )
    return "\n".join(lines)


def leaderboard(scenario: Problem, filters: Sequence[Contender], seeds: int = SEEDS) -> Leaderboard:
    """Filters on a scenario's held-out seeds."""
    (board,), interrupted = compare(filters, [scenario], held_out_seeds(0, seeds))
    if interrupted:
        raise KeyboardInterrupt
    return board


def table_of(board: Leaderboard) -> str:
    """RMSE by state with its distance from the bound, the paired ratio, and consistency, a row per filter."""
    lines = [f"| filter | {' | '.join(COLUMNS).format(board.rows[0].label)} |", "|---" * 8 + "|"]
    for row in board.rows:
        cells = [row.label]
        for rmse, above, ratio, decimals in zip(
            row.evaluation.rmse, row.above_bound, row.ratios, (3, 4), strict=True
        ):
            cells.append(f"{_about(rmse, decimals)} ({100 * above:+.0f} %)")
            cells.append("" if row is board.rows[0] else _about(ratio, 3))
        nees = f"{row.nees:.2f} (median)" if row.nees_is_median else unless_blank(row.nees, ".3g")
        cells += [nees, unless_blank(row.evaluation.nis.value, ".3g")]
        cells.append(unless_blank(row.evaluation.log_likelihood, ".0f"))
        lines.append(f"| {' | '.join(cells)} |")
    bound = f"| bound | {board.bound[0]:.3f} | | {board.bound[1]:.4f} | | 2 (median 1.39) | 1 | |"
    return "\n".join([*lines, bound])


def ratio_cell(row: Row) -> str:
    """The ratio of scores; bold where the filter is significantly better, in brackets where no worse either."""
    return marked(row.score_ratio)


def marked(ratio: Interval) -> str:
    """A ratio, bold if it is significantly below one, in brackets if it is not significantly above either."""
    text = f"{ratio.value:.3f}" if ratio.value < 1000 else "> 1000"
    return f"**{text}**" if ratio.high < 1 else text if ratio.low > 1 else f"({text})"


def _about(value: Interval, digits: int) -> str:
    return f"{value.value:.{digits}f} ± {(value.high - value.low) / 2:.{digits}f}"


TABLES: dict[str, Callable[[], str]] = {
    markdown_table.__name__: markdown_table
    for markdown_table in (
        speed,
        fast,
        outliers,
        ambient,
        published,
        reference,
        startup,
        every_filter,
        scores,
        scenarios,
    )
}


def main(
    arguments: Sequence[str] | None = None,
    tables: Mapping[str, Callable[[], str]] = TABLES,
    module: str = "pages.ranking_tables",
    about: str = __doc__,
    page: Path = DOCS / "ranking.md",
) -> None:
    """Run the command line of a script that makes tables of a page."""
    parser = argparse.ArgumentParser(prog=f"python -m {module}", description=about.splitlines()[0])
    parser.add_argument("page", nargs="?", type=Path, default=page, metavar="PAGE")
    parser.add_argument("--table", action="append", choices=list(tables), help="only this one; may be repeated")
    options = parser.parse_args(arguments)
    for name in options.table or tables:  # written one by one, so that what is done stays
        write_whole(options.page, with_tables(options.page.read_text(), {name: tables[name]}))


if __name__ == "__main__":
    main()
