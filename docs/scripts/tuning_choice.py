"""The tables of docs/appendix/tuning.md on wrong choices; each takes some minutes.

A study here is a Kalman filter of x_{k+1} = 0.95 x_k + w, z = x + v, whose Q and R come from a grid. The six grid
points that are best on the training runs meet the given Q and R on validation runs, and the choice is that of
`tuning.search.validation`. It is wrong if the held-out 95 % interval, paired by run, says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from docs.scripts import by_name
from thruster_env.core.text_tables import markdown_table
from thruster_env.logs.log import Log
from thruster_env.model.affine import affine_model
from tuning.problems.log_parts import Block, parts_of
from tuning.problems.log_problem import LogProblem
from tuning.search.measures import Measured, Runs, over, signed_rank
from tuning.search.plan import HELD_OUT_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS, Plan
from tuning.search.validation import Choosing

A, Q, R = 0.95, 0.05, 0.3
GRID = np.array([(q, r) for q in np.logspace(-2.6, 0.8, 12) for r in np.logspace(-1.3, 0.7, 8)])
FINALISTS = 6
ROWS, SHORT_ROWS, RUN_STEPS, LEAD_IN = 1500, 200, 60, 20
STUDIES, TRUTH_STUDIES, SIZE_STUDIES = 200, 300, 2000
CHUNK = 50  # studies that are simulated at once
GIVEN = "given"
TIMES = (0, 60, 120, 240)  # time constants of scores [rows]

NOISE = {"process_noise_cov": [Q], "measurement_noise_cov": [R]}
MODEL = affine_model(a=[[A]], b=[[1.0]], c=[[1.0]], **NOISE, prior_mean=[0.0], prior_cov=[1.0])


class Case(NamedTuple):
    """Logs or runs, and the Q and R that the user had."""

    about: str
    user_factors: tuple[float, float] = (1.0, 1.0)  # on Q and R of the plant, or of the optimum on other logs
    runs: Mapping[str, Any] = {}  # of `simulated`, for all logs
    second: Mapping[str, Any] | None = None  # of the second of three logs, if it differs
    rows: int = ROWS
    from_optimum: bool = False


BURST = {"burst": (30, 6.0, 1.0)}  # rows, and factors on the deviations of w and v
CASES = (
    Case("given: Q x 10", (10.0, 1.0)),
    Case("given: Q x 2", (2.0, 1.0)),
    Case("given = the plant's"),
    Case("given = optimum of other logs, t noise of 2.5 degrees in w", runs={"w_degrees": 2.5}, from_optimum=True),
    Case("the same, Q / 4", (0.25, 1.0), {"w_degrees": 2.5}, from_optimum=True),
    Case("given = optimum of other logs, 1 % outliers of 10 sigma", runs={"outliers": 0.01}, from_optimum=True),
    Case("the same, Q / 4", (0.25, 1.0), {"outliers": 0.01}, from_optimum=True),
    Case("one log has 30 rows with 6 times the noise; given: Q / 5", (0.2, 1.0), second=BURST),
    Case(
        "one log has 30 rows with 10 times the sensor noise; given: R / 2.5",
        (1.0, 0.4),
        second={"burst": (30, 1, 10)},
    ),
    Case("the same, given = the plant's of the other rows", second={"burst": (30, 1.0, 10.0)}),
    Case("one log has 4 times the noise; given = the plant's of the others", second={"q": 16.0 * Q}),
    Case("one log has 2 times the noise; given: Q / 3", (1 / 3, 1.0), second={"q": 4.0 * Q}),
    Case("logs of 200 rows; given: Q x 10", (10.0, 1.0), rows=SHORT_ROWS),
    Case("logs of 200 rows; given = the plant's", rows=SHORT_ROWS),
    Case(
        "slow drift of the sensor, unmodelled; given = optimum of other logs",
        runs={"drift": 1.0},
        from_optimum=True,
    ),
)
TRUTH_CASES = (
    Case("given: Q x 3", (3.0, 1.0)),
    Case("given: Q x 1.3", (1.3, 1.0)),
    Case("given = the plant's"),
    Case("1 % outliers of 10 sigma; given: Q x 3", (3.0, 1.0), {"outliers": 0.01}),
    Case("1 % outliers of 10 sigma; given = the core's", (1.0, 1.0), {"outliers": 0.01}),
    Case("3 % of runs have 30 times the noise in 10 rows; given: Q x 1.5", (1.5, 1.0), {"rare": (0.03, 10, 30.0)}),
    Case("the same, given = the plant's of the other runs", (1.0, 1.0), {"rare": (0.03, 10, 30.0)}),
)


class Rates(NamedTuple):
    """Shares of studies [%]."""

    changed: float  # a trial is taken
    false_keeps: float  # what was given is kept, and the best trial is significantly better held out
    false_changes: float  # a trial is taken, and it is significantly worse held out


def simulated(
    generator: np.random.Generator,
    runs: int,
    rows: int,
    *,
    q: float = Q,
    w_degrees: float = 0.0,
    outliers: float = 0.0,
    drift: float = 0.0,
    burst: tuple[int, float, float] | None = None,
    rare: tuple[float, int, float] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """States and measurements of the plant, (rows, runs) each.

    Args:
        generator: of random numbers.
        runs: their number.
        rows: of each.
        q: variance of w.
        w_degrees: degrees of freedom of w, Student's t of the same variance; 0 for a normal distribution.
        outliers: share of measurements with ten times the noise.
        drift: deviation of a sensor drift with a time constant of 300 rows, over that of v.
        burst: rows in which w and v have so many times the deviation, anywhere after row 60.
        rare: share of runs with a burst, its rows, and the factor on w.
    """
    w, v = generator.standard_normal((2, rows, runs))
    if w_degrees:
        w = generator.standard_t(w_degrees, (rows, runs)) * np.sqrt(1.0 - 2.0 / w_degrees)
    v = np.where(generator.random((rows, runs)) < outliers, 10.0 * v, v)
    if drift:
        v += drift * _slow(generator.standard_normal((rows, runs)), 300.0)
    if burst is not None or rare is not None:
        length, of_w, of_v = burst if burst is not None else (*rare[1:], 1.0)
        first = generator.integers(min(LEAD_IN, 60), rows - length, runs)
        if rare is not None:
            first = np.where(generator.random(runs) < rare[0], first, rows)
        inside = (np.arange(rows)[:, None] >= first) & (np.arange(rows)[:, None] < first + length)
        w, v = np.where(inside, of_w * w, w), np.where(inside, of_v * v, v)
    states, x = np.empty((rows, runs)), np.zeros(runs)
    for row in range(rows):
        states[row] = x = A * x + np.sqrt(q) * w[row]
    return states, states + np.sqrt(R) * v


def _slow(noise: np.ndarray, time: float) -> np.ndarray:
    """A first-order process of unit variance from white noise (rows, ...)."""
    r, values = np.exp(-1.0 / time), noise.copy()
    for row in range(1, len(noise)):
        values[row] = r * values[row - 1] + np.sqrt(1.0 - r * r) * noise[row]
    return values


def scores(states: np.ndarray, measured: np.ndarray, grid: np.ndarray, truth: bool) -> np.ndarray:
    """Square errors or negative log-likelihoods of Kalman filters, (rows, runs, grid)."""
    q, r = grid.T
    p, x = np.ones(len(q)), np.zeros((measured.shape[1], len(q)))
    values = np.empty((*measured.shape, len(q)), np.float32)
    for row in range(len(measured)):
        p, x = A * A * p + q, A * x
        s = p + r
        innovation = measured[row, :, None] - x
        x, p = x + p / s * innovation, p * r / s
        values[row] = (
            (states[row, :, None] - x) ** 2 if truth else 0.5 * (np.log(2.0 * np.pi * s) + innovation**2 / s)
        )
    return values


def empty_logs(count: int, rows: int) -> list[Log]:
    """Logs of zeros, for their blocks."""
    channels = MODEL.input_quantities, MODEL.measurements
    return [Log(f"run{i}", 1.0, np.zeros((rows - 1, 1)), np.zeros((rows, 1)), *channels) for i in range(count)]


def blocks_of(logs: int, rows: int) -> tuple[list[Block], list[Block], list[Block], int]:
    """Training, validation and held-out blocks of logs, and their lead-in."""
    parts = parts_of(empty_logs(logs, rows), sizes=True)
    training, validation, held_out = (
        [parts.blocks[i] for i in numbers] for numbers in (parts.training, parts.sizes, parts.held_out)
    )
    return training, validation, held_out, parts.lead


def plan_of(truth: bool) -> Plan:
    """A plan whose objective is the score or the likelihood, without a band on the NIS."""
    problem = LogProblem(empty_logs(3, 400), MODEL, apart=False)
    return Plan("kf", (problem,), objectives=("score" if truth else "likelihood",), consistent=False)


def measured_of(values: np.ndarray, truth: bool, logs: np.ndarray | None = None) -> Measured:
    """A filter by its values (B,) of each run: mean square errors, or negative log-likelihoods."""
    count, total = len(values), values.sum()
    root = np.sqrt if truth else np.asarray
    left_out = root((total - values) / (count - 1))
    ones = np.ones(count)
    return Measured(
        float(root(total / count)),
        (left_out,),
        0.0,
        (1.0,),
        runs=(Runs(values[:, None], ones, ones, logs),),
        decisive=(0,),
    )


def is_significant(a: Measured, b: Measured, truth: bool) -> tuple[bool, bool]:
    """Whether a filter is significantly better than another one, and whether significantly worse."""
    ratio, equal = over(a, b, ratio=truth), float(truth)
    return ratio.high < equal, ratio.low > equal


def chosen_by(choosing: Choosing) -> str:
    """The choice of a study: the first trial in order that can be taken."""
    return next((name for name in choosing.order() if choosing.wins(name)), GIVEN)


def case_rates(case: Case, truth: bool, studies: int = STUDIES, chunk: int = CHUNK) -> Rates:
    """Rates of wrong choices in a case.

    Args:
        case: what is simulated, and given.
        truth: whether errors of runs are compared, and not likelihoods of blocks of three logs.
        studies: their number.
        chunk: studies that are simulated at once.
    """
    plan, counts = plan_of(truth), np.zeros(3)
    start = _optimum(case.runs) if case.from_optimum else np.array([Q, R])
    grid = np.vstack([GRID, start * case.user_factors])
    for first in range(0, studies, chunk):
        generator, count = np.random.default_rng(first), min(chunk, studies - first)
        training, validation, held_out, logs = (_runs_of if truth else _blocks_of)(case, grid, generator, count)
        for study in range(count):
            counts += _outcome(plan, truth, training[study], validation[study], held_out[study], logs)
    return Rates(*(100.0 * counts / studies))


def _outcome(plan, truth, training, validation, held_out, logs) -> np.ndarray:
    """Whether one study takes a trial, keeps wrongly and changes wrongly."""
    finalists = np.argsort(training.sum(axis=0)[:-1])[:FINALISTS].tolist()
    trials = {str(i): measured_of(validation[:, i], truth, logs) for i in finalists}
    choosing = Choosing(plan, {GIVEN: measured_of(validation[:, -1], truth, logs)}, trials)
    chosen = chosen_by(choosing)
    tested = {name: measured_of(held_out[:, int(name)], truth) for name in {choosing.best, chosen} - {GIVEN}}
    baseline = measured_of(held_out[:, -1], truth)
    if chosen == GIVEN:
        return np.array([False, is_significant(tested[choosing.best], baseline, truth)[0], False])
    return np.array([True, False, is_significant(tested[chosen], baseline, truth)[1]])


def _optimum(runs: Mapping[str, Any]) -> np.ndarray:
    """The most likely Q and R of the grid on other, long logs."""
    values = scores(*simulated(np.random.default_rng(999), 8, 4000, **runs), GRID, False)
    return GRID[values.sum(axis=(0, 1)).argmin()]


def _blocks_of(case: Case, grid: np.ndarray, generator: np.random.Generator, studies: int):
    """Sums of negative log-likelihoods over blocks, (studies, blocks, grid)."""
    sums = []
    for log in range(3):
        options = case.second if log == 1 and case.second is not None else case.runs
        values = scores(*simulated(generator, studies, case.rows, **options), grid, False)
        sums.append(np.cumsum(np.concatenate([np.zeros_like(values[:1]), values]), axis=0, dtype=np.float64))
    training, validation, held_out, lead = blocks_of(3, case.rows)
    arrays = [
        np.stack(
            [sums[block.run][block.first + block.rows] - sums[block.run][block.first + lead] for block in blocks],
            axis=1,
        )
        for blocks in (training, validation, held_out)
    ]
    return *arrays, np.array([block.run for block in validation])


def _runs_of(case: Case, grid: np.ndarray, generator: np.random.Generator, studies: int):
    """Mean square errors of training, validation and held-out runs, (studies, runs, grid)."""
    arrays = []
    for count in (TRAINING_SEEDS, VALIDATION_SEEDS, HELD_OUT_SEEDS):
        states, measured = simulated(generator, studies * count, RUN_STEPS, **case.runs)
        values = scores(states, measured, grid, True)[LEAD_IN:].mean(axis=0, dtype=np.float64)
        arrays.append(values.reshape(studies, count, -1))
    return *arrays, None


def choice_size(time: float, heavy: bool, studies: int = SIZE_STUDIES) -> tuple[float, float, float, float]:
    """Shares [%] of studies that take a trial which is as good as what was given, if scores are autocorrelated.

    Differences of scores have the mean zero and a time constant. Blocks as of three logs of 1500 rows.

    Returns:
        By Student's interval over all blocks of the two logs, one after the other; over those that are set aside,
        every third; by signed ranks of these; by the choice, which takes either, with the effective number.
    """
    generator, length, count = np.random.default_rng(5), 60, 24
    noise = (
        generator.standard_t(2.5, (2, length * count, studies))
        if heavy
        else generator.standard_normal((2, length * count, studies))
    )
    rows = [_slow(log, time) if time else log for log in noise]
    blocks = np.concatenate([log.reshape(count, length, studies).sum(axis=1) for log in rows])
    logs, plan, accepted = np.repeat([0, 1], count), plan_of(False), np.zeros(4)
    for values in blocks.T:
        zero = np.zeros_like(values)
        all_blocks = [measured_of(part, False) for part in (values, zero)]
        apart = [measured_of(part[2::3], False) for part in (values, zero)]
        trial, baseline = (measured_of(part[2::3], False, logs[2::3]) for part in (values, zero))
        choosing = Choosing(plan, {GIVEN: baseline}, {"0": trial})
        accepted += [
            is_significant(*all_blocks, False)[0],
            is_significant(*apart, False)[0],
            signed_rank(*apart, ratio=False) < 0.025 and apart[0].value < 0.0,
            choosing.wins("0"),
        ]
    return tuple((100.0 * accepted / studies).tolist())


def _table(cases: Sequence[Case], truth: bool, studies: int) -> str:
    rows = []
    for case in cases:
        rates = case_rates(case, truth, studies)
        rows.append([case.about, *(f"{share:.1f}" for share in rates)])
    return markdown_table(["case", "changed [%]", "false keeps [%]", "false changes [%]"], rows)


def log_choices(studies: int = STUDIES) -> str:
    """Wrong choices on logs, a row a case."""
    return _table(CASES, False, studies)


def truth_choices(studies: int = TRUTH_STUDIES) -> str:
    """Wrong choices on seeds with true states, a row a case."""
    return _table(TRUTH_CASES, True, studies)


def choice_sizes(studies: int = SIZE_STUDIES) -> str:
    """Sizes of the tests under autocorrelated scores, a row a time constant."""
    rows = []
    for heavy in (False, True):
        for time in TIMES:
            blocks, _, _, choice = choice_size(time, heavy, studies)
            rows.append(["t, 2.5 degrees" if heavy else "normal", str(time), f"{blocks:.1f}", f"{choice:.1f}"])
    heads = "all blocks, Student [%]", "the choice [%]"
    return markdown_table(["scores", "time constant [rows]", *heads], rows)


TABLES = by_name(log_choices, truth_choices, choice_sizes)
