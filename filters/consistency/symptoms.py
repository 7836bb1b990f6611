"""Symptoms in the innovations that no Q and R can cure, and their remedies."""

from __future__ import annotations

from filters.consistency.report import ConsistencyReport

HEAVY = 6.0  # kurtosis of innovations; of Laplace's distribution
STUCK = 40  # equal readings in a row, beyond what a quantised sensor at rest gives for long


def symptoms(report: ConsistencyReport) -> list[str]:
    """A remedy for each symptom that a report shows, without a full stop; none where it shows none."""
    said = []
    stuck = [name for name, longest in zip(report.channels, report.repeats, strict=False) if longest >= STUCK]
    if stuck:
        said.append(
            f"look at {', '.join(stuck)}, which has {max(report.repeats)} equal readings in a row: a stuck "
            "sensor does not measure; replace its readings by NaN"
        )
    elif any(one > HEAVY for one in report.tails):
        said.append(
            "a filter that models outliers, `--filter ekf-robust`, because innovations have heavy tails "
            f"(kurtosis {max(report.tails):.3g} where 3 is normal); `thruster identify --gate` leaves them "
            "out"
        )
    if report.divergences:
        said.append("more substeps of the model, or a smaller sample time, because estimates blow up")
    return said
