"""The runs of the bow thruster papers: systems, settings, and the form of a table.

Source: M. Kiki (2020) and H. Nurhadi, M. Kiki, D. Adzkiya, T. Herlambang (2022), cited in full in `kiki2020`
and `nurhadi2022`; the model goes back to A. J. Healey et al. (1995), "Toward an improved understanding of
thruster dynamics for underwater vehicles", IEEE J. Oceanic Engineering 20(4).
"""

from __future__ import annotations

from typing import NamedTuple

from thruster_env.thruster.linear.published import PUBLISHED

# The cases by the names of the papers.
SYSTEMS = {"tunnel": PUBLISHED["tunnel"], "open-bladed": PUBLISHED["open_bladed"]}

STEPS = 100
H = SYSTEMS["tunnel"].c  # the measurement matrix of both cases: the tunnel's C serves the open-bladed case too
NOISE_LEVELS = (0.5, 0.6, 0.8, 1.0)  # q in Q = R = q I


class PublishedRMSE(NamedTuple):
    """One cell of a published table."""

    omega_m: float  # [rad/s]
    U_a: float  # [m/s]
    note: str = ""  # misprint, if there is one
    in_text: tuple[float, float] | None = None  # the pair in the paper's text, if it differs

    @property
    def meant(self) -> tuple[float, float]:
        """The most probable pair: that of the text, where it differs from the table."""
        return self.in_text or (self.omega_m, self.U_a)


class PublishedTable(NamedTuple):
    """The RMSE table of one paper."""

    name: str
    source: str
    kf: dict[tuple[str, float], PublishedRMSE]  # by (case, q)
    enkf: dict[tuple[str, float], PublishedRMSE]
    remarks: tuple[str, ...]  # what a reader of the paper should know
