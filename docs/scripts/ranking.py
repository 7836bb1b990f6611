"""Which filter beats which where, on held-out seeds: the tables of docs/appendix/ranking.md."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import numpy as np
from scipy.stats import chi2

from docs.scripts import about, by_name, digits
from filters import StateSpaceModel, Unknown, make_filter, run
from filters.consistency.nees import Interval, rmse_intervals, whitened
from filters.filter import Filter
from filters.horizon.window import STUDENT
from filters.registry import FILTERS, filter_type
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.core.text_tables import markdown_table
from thruster_env.model.simulate import simulate
from tuning.evaluation.compare import Contender, Leaderboard, Row, compare, contender
from tuning.experiments import mixed_linear
from tuning.plants.thruster import SCENARIOS, find_scenario
from tuning.problems.data import held_out_seeds
from tuning.problems.find import find_problem
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Problem
from tuning.reporting.tables import unless_blank
from tuning.search.parameters import KALMAN_SIZES, ensemble_sizes_of

SEEDS = 200
REFERENCE_SEEDS, REFERENCE_SIZE = 20, 100_000
EKF, ROBUST, IMM, IEKF, UKF, GSF = map(contender, ("ekf", "ekf-robust", "imm", "iekf", "ukf", "gsf"))
PF, MANY = contender("pf"), contender("pf", ensemble_size=5000)
ENKF, IENKF = (contender(name, ensemble_size=100) for name in ("enkf", "ienkf"))
SMALL = contender("enkf", ensemble_size=30)
SMALL_INFLATED = contender("enkf", ensemble_size=30, inflation=1.1)
RANKED = contender("rhf", ensemble_size=100)
SMALL_FINITE = contender("enkf-n", ensemble_size=30)
FLOW = {"ambient_velocity": None}
DISCUSSED = "nominal published_noise outliers deadband mismatch ambient startup speed_magnitude".split()
VEHICLE, VEHICLE_SEEDS = ("auv:motion", "auv:dvl_outliers", "auv:wrong_drag"), 50
COLUMNS = ("omega_m [rad/s]", "over {0}", "U_a [m/s]", "over {0}", "NEES")


def compared(scenario: str, filters: Sequence[Contender], seeds: int = SEEDS) -> Callable[[], str]:
    """The table of filters on a scenario."""
    return lambda: table_of(leaderboard(find_scenario(scenario), filters, seeds))


ENSEMBLES = [SMALL, SMALL_INFLATED, SMALL_FINITE, ENKF, IENKF]
PARTICLES = [contender("pf", proposal="optimal"), contender("pf", resampling="gaussian", resampling_threshold=1.0)]
MARGINAL = [contender("rbpf", sampled=(component,)) for component in (0, 1)]
BY_SPEED = contender("gsf", component=0)  # the sum is split along omega_m
JOINT_EKF, JOINT_ENKF = contender("ekf", unknown=FLOW), contender("enkf", unknown=FLOW, ensemble_size=100)
REFERENCE = contender("pf", ensemble_size=REFERENCE_SIZE)  # so many particles that more change nothing
COMPARED = {
    "speed": compared("speed_magnitude", [EKF, UKF, BY_SPEED, ENKF, RANKED, PF, MANY, *MARGINAL]),
    "outliers": compared("outliers", [EKF, ROBUST, IMM, ENKF, PF]),
    "ambient": compared("ambient", [EKF, JOINT_EKF, ENKF, JOINT_ENKF]),
    "published": compared("published_noise", [EKF, IEKF, UKF, *ENSEMBLES, GSF, PF, MANY, *PARTICLES, MARGINAL[1]]),
    "reference": compared("published_noise", [REFERENCE, EKF, IEKF, IENKF, GSF, PF], REFERENCE_SEEDS),
}


def startup() -> str:
    """RMSE of the first 50 steps from an unknown state."""
    lines = ["| filter | omega_m [rad/s] | U_a [m/s] |", "|---|---|---|"]
    for row in leaderboard(find_scenario("startup"), [EKF, IEKF, UKF, ENKF, GSF, PF]).rows:
        speed_error, flow_error = row.evaluation.start_up_rmse
        lines.append(f"| {row.label} | {speed_error:.1f} | {flow_error:.3f} |")
    return "\n".join(lines)


def scores() -> str:
    """Scores over that of the EKF, a row per scenario that is not a column of `every_filter`."""
    filters = [EKF, ROBUST, IMM, IEKF, UKF, ENKF, GSF, PF]
    boards = [leaderboard(scenario, filters) for name, scenario in SCENARIOS.items() if name not in DISCUSSED]
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
        usual = type(scenario.excitation)().as_mapping()
        changed = [
            f"{key} {value}" for key, value in scenario.excitation.as_mapping().items() if value != usual[key]
        ]
        excitation = f"`{scenario.excitation.name}`" + (f": {', '.join(changed)}" if changed else "")
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
    """RMSE by state, the paired ratio, and consistency, a row per filter."""
    lines = [f"| filter | {' | '.join(COLUMNS).format(board.rows[0].label)} |", "|---" * 6 + "|"]
    for row in board.rows:
        cells = [row.label]
        for rmse, ratio, decimals in zip(row.evaluation.rmse, row.ratios, (3, 4), strict=True):
            cells.append(f"{rmse.value:.{decimals}f}")
            cells.append("" if row is board.rows[0] else about(ratio))
        nees = f"{row.nees:.2f} *" if row.nees_is_median else unless_blank(row.nees, ".3g")
        lines.append(f"| {' | '.join([*cells, nees])} |")
    bound = f"| bound | {board.bound[0]:.3f} | | {board.bound[1]:.4f} | | 2 (1.39 *) |"
    return "\n".join([*lines, bound])


def ratio_cell(row: Row) -> str:
    """The ratio of scores; bold where the filter is significantly better, in brackets where no worse either."""
    return marked(row.score_ratio)


def marked(ratio: Interval) -> str:
    """A ratio, bold if it is significantly below one, in brackets if it is not significantly above either."""
    text = f"{ratio.value:.3f}" if ratio.value < 1000 else "> 1000"
    return f"**{text}**" if ratio.high < 1 else text if ratio.low > 1 else f"({text})"


Numbers = dict[str, object]
PRINTED = 3  # of four states the first and the last
KINDS: list[tuple[str, Numbers]] = [
    ("pf", {"ensemble_size": 100, "proposal": "optimal"}),
    ("pf", {"ensemble_size": 1000, "proposal": "optimal"}),
    ("pf", {"ensemble_size": 1000, "resampling": "gaussian", "resampling_threshold": 1.0}),
]


def conditional() -> str:
    """A model that is linear where one state is known."""
    filters: list[tuple[str, Numbers]] = [("ekf", {}), ("ukf", {})]
    filters += [("pf", {"ensemble_size": size}) for size in (100, 300, 1000, 10_000)]
    filters += [("rbpf", {"ensemble_size": size}) for size in (30, 100, 1000)]
    return particle_errors(mixed_linear.problem, [*filters, *KINDS])


def accurate() -> str:
    """The same with accurate sensors."""
    filters: list[tuple[str, Numbers]] = [("ekf", {}), ("ukf", {}), ("enkf", {"ensemble_size": 100})]
    filters += [("pf", {"ensemble_size": size}) for size in (100, 1000, 10_000)]
    filters += [("apf", {"ensemble_size": 1000}), *KINDS, ("rbpf", {"ensemble_size": 100})]
    return particle_errors(mixed_linear.problem_of(mixed_linear.model(1e-3)), filters)


def constants() -> str:
    """A flow that is a further state, constant, for particles whose copies stay together or are smoothed."""
    known = {"ambient_velocity": Unknown(std=1.0)}
    filters = [contender("ekf", unknown=known), contender("enkf", unknown=known, ensemble_size=100)]
    for size in (300, 1000):
        filters.append(contender("pf", unknown=known, ensemble_size=size))
        smoothed = contender("pf", unknown=known, ensemble_size=size, smoothed=(-1,), regularisation=1.0)
        filters.append(smoothed._replace(label=f"pf {size} smoothed + U_0"))
    return compared("ambient", filters)()


def particle_errors(problem: ModelProblem, filters: list[tuple[str, Numbers]]) -> str:
    """RMSE by state, the median NEES and the log-likelihood, a row per filter."""
    data, model = problem.data(held_out_seeds(0, SEEDS)), problem.model()
    symbols = [state.symbol for state in model.states][::PRINTED]
    rows = []
    for name, numbers in filters:
        estimates = run(make_filter(name, model, **numbers), data.filter_keys, data.inputs, data.measurements)
        errors, covs = (estimates.means - data.states)[:, data.late], estimates.covs[:, data.late]
        parts = rmse_intervals(np.square(errors).mean(axis=1))
        squares = np.square(whitened(errors, covs)).sum(axis=-1)
        nees = np.median(np.where(np.isnan(squares), np.inf, squares))  # of a singular P: no error is within it
        level = estimates.log_likelihoods[:, data.late].sum(axis=1).mean()
        label = " ".join([name, *(str(value) for key, value in numbers.items() if key != "resampling_threshold")])
        cells = [about(part) for part in parts[::PRINTED]]
        rows.append([label, *cells, f"{nees / chi2.median(model.n):.2f}", f"{level:.1f}"])
    return markdown_table(["filter", *symbols, "NEES", "log L"], rows)


BATCH_STEPS, SETTLED = 100, 20  # of a batch, of which errors count from a step on
POSITIVE = {0: (0.0, None), 1: (0.0, None)}


def react(x, u, c):
    """Partial pressures of A and B after 0.1 of a time unit of 2 A -> B at k = 0.16, solved exactly."""
    left = x[0] / (1.0 + 0.032 * x[0])
    return left, x[1] + 0.5 * (x[0] - left)


def total_pressure(x, c):
    """The sum of the pressures, which is measured."""
    return (x[0] + x[1],)


def reactor(prior_mean: Sequence[float], prior_cov: Sequence[float], **changes) -> StateSpaceModel:
    """A batch reactor, as its operator believes it to begin.

    Source: Haseltine, Rawlings (2005), "Critical evaluation of extended Kalman filtering and moving-horizon
    estimation", Industrial & Engineering Chemistry Research 44(8), section 4.1.
    """
    return StateSpaceModel(
        transition=react,
        observe=total_pressure,
        process_noise_cov=[1e-6, 1e-6],
        measurement_noise_cov=[0.01],
        prior_mean=prior_mean,
        prior_cov=prior_cov,
        inputs=0,
        **changes,
    )


def assumed(**changes) -> StateSpaceModel:
    """The reactor as filters assume it."""
    return reactor([0.1, 4.5], [36.0, 36.0], **changes)


def batches(count: int) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """What `filters.run` takes of batches, and their states (count, K + 1, 2)."""
    seeds, inputs = held_out_seeds(0, count), np.zeros((count, BATCH_STEPS, 0))
    truth = simulate(reactor([3.0, 1.0], [0.0, 0.0]), episode_keys(seeds), inputs)
    return (filter_keys(seeds), inputs, truth.measurements), truth.states


def batch_reactor() -> str:
    """A batch reactor whose initial pressures are far from what the filters assume."""
    arguments, states = batches(SEEDS)
    rows = []
    for label, filter_ in _of_reactor().items():
        estimates = run(filter_, *arguments)
        errors = estimates.means - states
        rmse = np.sqrt(np.square(errors[:, SETTLED:]).mean(axis=(0, 1)))
        lost = (np.abs(errors[:, -1]).max(axis=1) > 0.5).sum()
        row = [label, *map(digits, rmse), digits(estimates.means[:, 1:, 0].min()), f"{lost} of {SEEDS}"]
        rows.append(row)
    return markdown_table(["filter", "p_A", "p_B", "least p_A", "lost"], rows)


def _of_reactor() -> dict[str, Filter]:
    within = {by: assumed(bounds=POSITIVE, bounded_by=by) for by in ("truncation", "projection")}
    filters: dict[str, Filter] = {
        name: make_filter(name, assumed(), **numbers)
        for name, numbers in (("ekf", {}), ("iekf", {}), ("ukf", {}), ("enkf", {"ensemble_size": 100}))
    }
    for by, model in within.items():
        filters |= {f"{name}, bounded by {by}": make_filter(name, model) for name in ("ekf", "ukf")}
    filters["mhe without bounds"] = make_filter("mhe", assumed())
    for length in (5, 10, 30):
        filters[f"mhe, L = {length}"] = make_filter("mhe", within["projection"], horizon=length)
    filters["mhe, L = 30, Student's loss"] = make_filter("mhe", within["projection"], horizon=30, loss=STUDENT)
    return filters


TABLES = {
    **COMPARED,
    **by_name(startup, every_filter, scores, scenarios, conditional, accurate, constants, batch_reactor),
}
