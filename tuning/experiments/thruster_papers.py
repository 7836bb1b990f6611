"""Two papers on the bow thruster repeated with many runs: Kalman filter, ensemble Kalman filter and the optimum.

The papers compare a Kalman filter (KF) with an ensemble Kalman filter (EnKF) by the RMSE of one run, it seems.

Truth and filter share the model x' = A_d x + w, z = H x + v with Q = R = q I and zero input. The input has no
effect: it is known to truth and filters, and the errors of a linear filter do not depend on it.

The start. The papers print neither x_0 nor P_0. Here x_0 and the filter's prior are N(0, P_inf), P_inf being the
steady-state covariance of the *predicted* state. Our filters are updated with z_0 before they first predict, so
with this prior the Kalman filter's posterior covariance is the steady state's at every step, and its mean square
error has the Riccati optimum as expectation. Were P_inf the posterior covariance, the update with z_0 would make
the first steps better than the steady state. A second start, N(0, I), shows how little this matters.

Source: Kiki (2020) and Nurhadi et al. (2022), cited in full in `thruster_papers.toml`; the model goes back to
A. J. Healey et al. (1995), "Toward an improved understanding of thruster dynamics for underwater vehicles", IEEE
J. Oceanic Engineering 20(4).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from filters import EnsembleKalmanFilter, KalmanFilter, affine_model
from filters.bounds import riccati_covariances
from filters.engine.batch import run
from filters.ensembles.ensemble import LARGEST_ENSEMBLE
from thruster_env.core.checks import at_least, covariance_root, one_of, positive
from thruster_env.core.files import read_toml
from thruster_env.core.matrices import zero_order_hold
from thruster_env.core.streams import COMPARISON_STUDY, derived_generator
from thruster_env.core.text_tables import Table
from thruster_env.model.affine import AffineModel
from thruster_env.model.simulate import simulate
from thruster_env.thruster.linear import PUBLISHED, SAMPLE_TIME
from tuning.api.markers import FILTER, Option, PythonOnly, Seed
from tuning.api.markers import RUNS as RUNS_PANEL
from tuning.api.result import Printed
from tuning.cli.output import progress_of

# The cases by the names of the papers.
SYSTEMS = {"tunnel": PUBLISHED["tunnel"], "open-bladed": PUBLISHED["open_bladed"]}
STEPS = 100
H = SYSTEMS["tunnel"].c  # the measurement matrix of both cases: the tunnel's C serves the open-bladed case too
NOISE_LEVELS = (0.5, 0.6, 0.8, 1.0)  # q in Q = R = q I
_BLOCK = 128  # runs at a time, whose members fit the processor's cache
RUNS = 200
MOST_RUNS = 100_000  # which take a gigabyte
MEMBERS = 200  # the RMSE is about 0.6 % above the Kalman filter's; with 100 members it is 1.2 %
RESAMPLES = 2000

# Of the comparison with published values.
CLOSE = 2.0  # standard deviations of a single run within which a published value is explained
EQUAL = 0.06  # relative difference up to which the errors of the two states are called equal
UNSEEN_RATIO = H[0][1] / H[0][0]  # omega_m over U_a [rad/m] of errors that are not observable by H


class PublishedRMSE(NamedTuple):
    """One cell of a published table."""

    omega_m: float  # [rad/s]
    U_a: float  # [m/s]
    note: str = ""  # misprint, if there is one
    in_text: Sequence[float] | None = None  # the pair in the paper's text, if it differs

    @property
    def meant(self) -> tuple[float, float]:
        """The most probable pair: that of the text, where it differs from the table."""
        omega_m, flow = self.in_text or (self.omega_m, self.U_a)
        return omega_m, flow


class PublishedTable(NamedTuple):
    """The RMSE table of one paper."""

    name: str
    source: str
    kf: dict[tuple[str, float], PublishedRMSE]  # by (case, q)
    enkf: dict[tuple[str, float], PublishedRMSE]
    remarks: Sequence[str]  # what a reader of the paper should know


def _cells(cells: Sequence[dict]) -> dict[tuple[str, float], PublishedRMSE]:
    return {(cell.pop("case"), cell.pop("q")): PublishedRMSE(**cell) for cell in cells}


STUDIES = {
    name: PublishedTable(name, paper["source"], _cells(paper["kf"]), _cells(paper["enkf"]), paper["remarks"])
    for name, paper in read_toml(Path(__file__).with_suffix(".toml"), "printed values").items()
}
"""The papers' tables by name, the latest first."""


def unupdated_ensemble_means(
    model: AffineModel, states: np.ndarray, members: int, generator: np.random.Generator
) -> np.ndarray:
    """Means of an ensemble filter whose members run free, with noise-free measurements and zero input.

        members:  x_j = A x_j + w_j,  w_j ~ N(0, Q),  from x_j ~ N(0, P_0), never corrected
        gain:     K = P H' (H P H' + R)^-1,  P the members' sample covariance
        mean:     m = A m,  then  m += K (H x - H m),  x the true state

    A correct filter replaces x_j by x_j + K (z + v_j - H x_j), which keeps P bounded. Here P follows the open
    loop. On an unstable system it grows without bound along the unstable direction e, and K tends to
    e / (H e): the gain assumes exact measurements and ignores the noise across e. It should not be used, so it is
    here and not in `filters`. Starting the truth at the known x_0 = 0 instead lowers the RMSE of the
    open-bladed case by about 1 %.

    Args:
        model: the model, one measurement, for truth and filter alike; prior mean zero, offsets ignored.
        states: true states, (runs, steps + 1, n), index 0 being the initial one.
        members: N, at least 2.
        generator: source of all draws.

    Returns:
        Corrected means, (runs, steps + 1, n).
    """
    a, _, _, c, _ = model.matrices()
    h, r = c[0], model.measurement_noise_cov[0, 0]
    prior_root, q_root = covariance_root(model.prior_cov), covariance_root(model.process_noise_cov)
    means = np.empty_like(states)
    for first in range(0, len(states), _BLOCK):
        truth = states[first : first + _BLOCK]
        shape = len(a), len(truth), members
        ensemble = np.tensordot(prior_root, generator.standard_normal(shape), 1)
        mean = np.zeros((len(truth), len(a)))
        for k in range(states.shape[1]):
            if k > 0:
                noise = np.tensordot(q_root, generator.standard_normal(shape), 1)
                ensemble = np.tensordot(a, ensemble, 1) + noise
                mean = mean @ a.T
            deviation = ensemble - ensemble.mean(axis=2, keepdims=True)
            predicted = np.tensordot(h, deviation, 1)  # (runs, N)
            cross_cov = np.einsum("irj,rj->ri", deviation, predicted) / (members - 1)  # P H'
            gain = cross_cov / (cross_cov @ h + r)[:, None]
            mean = mean + gain * ((truth[:, k] - mean) @ h)[:, None]
            means[first : first + _BLOCK, k] = mean
    return means


class Score(NamedTuple):
    """RMSE of an estimator, one entry for each state: (omega_m [rad/s], U_a [m/s])."""

    rmse: np.ndarray  # (2,), pooled over runs and over steps 1 ... 100
    low: np.ndarray  # (2,), 95 % interval of rmse, by bootstrap over runs ...
    high: np.ndarray  # (2,)
    run_std: np.ndarray  # (2,), standard deviation of the RMSE of a single run
    run_ratio: np.ndarray  # (2,), omega_m's RMSE over U_a's in a single run [rad/m]: mean, standard deviation


class Comparison(NamedTuple):
    """All estimators on one case at one noise level."""

    case: str
    q: float
    optimum: np.ndarray  # (2,), root of the diagonal of the steady-state posterior covariance
    kf: Score
    enkf: Score
    kf_identity: Score  # from x_0 ~ N(0, I), P_0 = I
    enkf_identity: Score
    unupdated: Score  # the wrong filter of `unupdated_ensemble`

    @property
    def enkf_over_kf(self) -> np.ndarray:
        """RMSE of the ensemble Kalman filter over that of the Kalman filter on the same runs, (2,)."""
        return self.enkf.rmse / self.kf.rmse


def discrete_model(case: str, q: float, prior_cov=None) -> AffineModel:
    """The published system by name, discretised, with Q = R = q I and the papers' H.

    Args:
        case: "tunnel" or "open-bladed".
        q: variance, positive.
        prior_cov: P_0, (2, 2) or two variances; the steady-state predicted covariance if None.

    Raises:
        ValueError: for an unknown case or a q that is not positive.
    """
    system, q = SYSTEMS[one_of("case", case, tuple(SYSTEMS))], positive("q", q)
    a, b = zero_order_hold(np.array(system.a), np.array(system.b), SAMPLE_TIME)
    model = affine_model(
        a=a,
        b=b,
        c=H,
        process_noise_cov=[q, q],
        measurement_noise_cov=[q],
        prior_mean=[0.0, 0.0],
        prior_cov=[1.0, 1.0] if prior_cov is None else prior_cov,
    )
    return model.replace(prior_cov=riccati_covariances(model)[0]) if prior_cov is None else model


def optimum(case: str, q: float) -> np.ndarray:
    """Least RMSE (2,) of any estimator in the steady state, from the Riccati equation."""
    return np.sqrt(np.diag(riccati_covariances(discrete_model(case, q))[1]))


def compare(case: str, q: float, *, runs: int = RUNS, members: int = MEMBERS, seed: int = 0) -> Comparison:
    """Run every estimator on the same runs of one case at one noise level.

    Args:
        case: "tunnel" or "open-bladed".
        q: noise variance, Q = R = q I.
        runs: independent runs of 100 steps, at least 2: the intervals come from their scatter.
        members: ensemble size N, at least 2.
        seed: seed of all random numbers; cases and noise levels have independent draws.

    Raises:
        ValueError: if an argument breaks its rule.
    """
    runs, members = at_least("runs", runs, 2, MOST_RUNS), at_least("members", members, 2, LARGEST_ENSEMBLE)
    seed = at_least("seed", seed, 0)
    stationary, identity = discrete_model(case, q), discrete_model(case, q, prior_cov=[1.0, 1.0])
    keys, generator = keys_of(case, q, runs, seed)
    inputs = np.zeros((runs, STEPS, stationary.inputs))

    errors = []
    for model in (stationary, identity):
        truth = simulate(model, keys, inputs)
        for filter_ in (KalmanFilter(model=model), EnsembleKalmanFilter(model=model, ensemble_size=members)):
            errors.append(run(filter_, keys, inputs, truth.measurements).means - truth.states)
        if model is stationary:
            free = unupdated_ensemble_means(model, truth.states, members, generator) - truth.states
    kf, enkf, kf_identity, enkf_identity, unupdated = scores([*errors, free], generator)
    return Comparison(case, q, optimum(case, q), kf, enkf, kf_identity, enkf_identity, unupdated)


def keys_of(case: str, q: float, runs: int, seed: int) -> tuple[np.ndarray, np.random.Generator]:
    """The keys (runs, 2) of the runs of one case at one noise level, and the generator of all other draws."""
    generator = derived_generator(seed, COMPARISON_STUDY, tuple(SYSTEMS).index(case), round(1000 * q))
    return generator.integers(0, 2**32, size=(runs, 2)).astype(np.float64), generator


def scores(errors: list[np.ndarray], generator: np.random.Generator) -> list[Score]:
    """Scores of estimators from their errors (runs, steps + 1, 2) on the same runs; index 0 is not scored."""
    runs = len(errors[0])
    # (runs, estimators, 2)
    mean_squares = np.stack([np.square(e[:, 1:]).mean(axis=1) for e in errors], axis=1)
    columns, share = mean_squares.reshape(runs, -1), np.full(runs, 1.0 / runs)
    resampled = np.sqrt([generator.multinomial(runs, share) @ columns / runs for _ in range(RESAMPLES)])
    low, high = np.percentile(resampled, (2.5, 97.5), axis=0).reshape(2, len(errors), -1)
    single = np.sqrt(mean_squares)
    ratio = single[..., 0] / single[..., 1]  # (runs, estimators)
    run_ratio = np.stack([ratio.mean(axis=0), ratio.std(axis=0, ddof=1)], axis=1)
    rmse, run_std = np.sqrt(mean_squares.mean(axis=0)), single.std(axis=0, ddof=1)
    return [Score(*parts) for parts in zip(rmse, low, high, run_std, run_ratio, strict=True)]


def compare_all(
    *,
    runs: int = RUNS,
    members: int = MEMBERS,
    seed: int = 0,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Comparison]:
    """`compare` for every case and noise level; on_progress(done, total) is called after each."""
    grid = [(case, q) for case in SYSTEMS for q in NOISE_LEVELS]
    comparisons = []
    for case, q in grid:
        comparisons.append(compare(case, q, runs=runs, members=members, seed=seed))
        on_progress(len(comparisons), len(grid))
    return comparisons


class Finding(NamedTuple):
    """One published cell beside ours; distances in standard deviations of the RMSE of a single run."""

    case: str
    q: float
    filter: str  # "kf" or "enkf"
    published: PublishedRMSE
    ours: Score
    optimum: np.ndarray  # (2,)
    unupdated: Score
    from_optimum: np.ndarray  # (2,), (published - optimum) / standard deviation
    from_unupdated: np.ndarray | None  # (2,), for the ensemble filter only
    why: str

    @property
    def over_optimum(self) -> np.ndarray:
        """Published RMSE over the optimum, (2,)."""
        return np.array(self.published[:2]) / self.optimum


def findings(table: PublishedTable, comparisons: list[Comparison]) -> list[Finding]:
    """A paper's table against the comparisons, Kalman filter first, in the comparisons' order."""
    results = []
    for comparison in comparisons:
        for name, cells, ours in (("kf", table.kf, comparison.kf), ("enkf", table.enkf, comparison.enkf)):
            cell = cells.get((comparison.case, comparison.q))
            if cell is not None:
                results.append(_finding(name, cell, ours, comparison))
    return results


def _finding(name: str, cell: PublishedRMSE, ours: Score, comparison: Comparison) -> Finding:
    case, q, optimum, unupdated = comparison.case, comparison.q, comparison.optimum, comparison.unupdated
    published = np.array(cell[:2])
    # A filter at the optimum scatters from run to run as our Kalman filter does.
    from_optimum = (published - optimum) / comparison.kf.run_std
    from_unupdated = (published - unupdated.rmse) / unupdated.run_std if name == "enkf" else None
    why = _why(published / optimum, from_optimum, from_unupdated)
    if cell.note:
        why = f"{cell.note}; {why}"
    return Finding(case, q, name, cell, ours, optimum, unupdated, from_optimum, from_unupdated, why)


def _why(over_optimum: np.ndarray, from_optimum: np.ndarray, from_unupdated: np.ndarray | None) -> str:
    optimal = bool((np.abs(from_optimum) < CLOSE).all())
    free = from_unupdated is not None and bool((np.abs(from_unupdated) < CLOSE).all())
    if optimal and free:
        return "a tie: within one run's scatter of the optimum (and of the un-updated ensemble)"
    if optimal:
        return "a tie: within one run's scatter of the optimum"
    factors = " and ".join(f"{factor:.1f}" for factor in over_optimum)
    if free:
        return f"{factors} times the optimum: like an ensemble that is never updated"
    return f"{factors} times the optimum: no mechanism known to us"


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
        values = _lines(f.published[:2]), _lines(f.ours.rmse), _distances(f.optimum, f.from_optimum)
        free = "" if f.from_unupdated is None else _distances(f.unupdated.rmse, f.from_unupdated)
        rows.append([f"{f.q:g}", "EnKF" if f.filter == "enkf" else "KF", *values, free, f.why])
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

    Example: thruster reproduce nurhadi2022 --json table.json

    Args:
        name: the paper, or both.
        runs: independent runs of 100 steps, at least 2; few make wide intervals.
        members: ensemble size N of the papers' EnKF, at least 2.
        seed: seed of all randomness; the same seed gives the same results.
    """
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
    return Printed(output, data)
