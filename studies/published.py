"""What the bow thruster papers print: two linear systems, the settings of the runs, and the form of a table.

Source: M. Kiki (2020) and H. Nurhadi, M. Kiki, D. Adzkiya, T. Herlambang (2022), cited in full in `kiki2020`
and `nurhadi2022`; the model goes back to A. J. Healey et al. (1995), "Toward an improved understanding of
thruster dynamics for underwater vehicles", IEEE J. Oceanic Engineering 20(4).
"""

from __future__ import annotations

from typing import NamedTuple


class PublishedSystem(NamedTuple):
    """dx/dt = A x + B u, T = C x for x = (omega_m [rad/s], U_a [m/s]), u = (V_s [V], U_0 [m/s]), T in N.

    The matrices are data: they are no linearisation of the nonlinear model beside which they are printed.
    """

    name: str
    a: tuple  # A (2, 2) [1/s], rows
    b: tuple  # B (2, 2), rows
    c: tuple  # C (1, 2), as printed; the runs did not use the open-bladed one, see H
    printed_a_d: tuple  # A_d (2, 2), zero-order hold at SAMPLE_TIME as printed, four decimals
    printed_b_d: tuple  # B_d (2, 2)


TUNNEL = PublishedSystem(
    name="tunnel",
    a=((-70.7, 1.2), (-2.1, -14.8)),
    b=((1133.2, 0.0), (0.0, 1.9)),
    c=((-2.03, -12.2),),
    printed_a_d=((0.4930, 0.0079), (-0.0139, 0.8623)),
    printed_b_d=((8.1241, 0.0001), (-0.0905, 0.0177)),
)

# Unstable, and an artefact: B and C both imply A_22 = -5.33, where -0.13 is printed.
OPEN_BLADED = PublishedSystem(
    name="open-bladed",
    a=((-523.7, -1519.8), (-1.15, -0.13)),
    b=((0.65, 0.0), (0.0, 2.73)),
    c=((-4.62, -10.4),),
    printed_a_d=((0.0116, -2.9445), (-0.0022, 1.0260)),
    printed_b_d=((0.0013, -0.0647), (0.0, 0.0276)),
)

SYSTEMS = {system.name: system for system in (TUNNEL, OPEN_BLADED)}

SAMPLE_TIME = 0.01  # [s]
STEPS = 100
H = TUNNEL.c  # the measurement matrix of both cases: the tunnel's C serves the open-bladed case too
NOISE_LEVELS = (0.5, 0.6, 0.8, 1.0)  # q in Q = R = q I


class PublishedRMSE(NamedTuple):
    """One cell of a published table."""

    omega_m: float  # [rad/s]
    U_a: float  # [m/s]
    note: str = ""  # what is wrong with the print, if anything


class PublishedTable(NamedTuple):
    """The RMSE table of one paper."""

    name: str
    source: str
    kf: dict[tuple[str, float], PublishedRMSE]  # by (case, q)
    enkf: dict[tuple[str, float], PublishedRMSE]
    remarks: tuple[str, ...]  # what a reader of the paper should know
