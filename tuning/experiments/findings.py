"""Published values against ours: their distance in standard deviations of one run, and its reason."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tuning.experiments.comparison import Comparison, Score
from tuning.experiments.published import STEPS, H, PublishedRMSE, PublishedTable

CLOSE = 2.0  # standard deviations of a single run within which a published value is explained
EQUAL = 0.06  # relative difference up to which the errors of the two states are called equal
UNSEEN_RATIO = H[0][1] / H[0][0]  # omega_m over U_a [rad/m] of errors that are not observable by H


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
    found = []
    for comparison in comparisons:
        for name, cells, ours in (("kf", table.kf, comparison.kf), ("enkf", table.enkf, comparison.enkf)):
            cell = cells.get((comparison.case, comparison.q))
            if cell is not None:
                found.append(_finding(name, cell, ours, comparison))
    return found


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


def study_statements(table: PublishedTable, found: list[Finding]) -> list[str]:
    """Statements that compare a paper's columns with ours, and the remarks on the paper."""
    tunnel, open_bladed = (
        [f for f in found if f.filter == "enkf" and f.case == case] for case in ("tunnel", "open-bladed")
    )
    clean = [f for f in tunnel + open_bladed if not f.published.note]
    unseen = sum(abs(f.published.omega_m / f.published.U_a / UNSEEN_RATIO - 1.0) < 0.01 for f in clean)
    right, right_std = np.mean([f.ours.run_ratio for f in clean], axis=0)
    kalman = [f for f in found if f.filter == "kf"]
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


def _farthest(found: list[Finding], distance: str) -> float:
    # A cell with a note is not a value of its row: a copied one belongs to another q.
    return max(float(np.abs(getattr(f, distance)).max()) for f in found if not f.published.note)


def _span(found: list[Finding], state: int | None = None) -> str:
    factors = np.array([f.over_optimum if state is None else f.over_optimum[state] for f in found])
    return f"{factors.min():.1f} to {factors.max():.1f}"
