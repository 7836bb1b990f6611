"""The two papers on the vehicle: what they print, their settings, and what filters assume of the vehicle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from thruster_env.auv.model import auv_model
from thruster_env.auv.parameters import SEGOROGENI
from thruster_env.core.checks import one_of
from thruster_env.model.state_space import StateSpaceModel

DT = 0.001  # [s]
NOISE = 1e-6  # Q = R = 1e-6 I, in the units of the velocities squared
MEASURED = ("u", "v", "w", "r")  # H picks these
POSE = ("x", "y", "z", "psi")  # [m], [m], [m], [rad]
FUZZY_LOW, FUZZY_HIGH = (0.0,) * 6, (1.0,) * 6  # bounds of the velocities; the rules are the corners
RUNS = 10  # "mean of 10 runs"
ANGLE_NOISE = 1e-6  # of roll and pitch, standard deviation per step [rad]: so Q of eight states is not singular
START = (1e-3,) * 6 + (1e-4,) * 2 + (0.0,) * 4  # standard deviations about rest at the origin; P_0 is not printed
WORLDS = {"vehicle": SEGOROGENI, "no restoring moments": SEGOROGENI._replace(zG=0.0)}
"""Segorogeni with our parameters, and the same with the centre of gravity at the centre of buoyancy.

Then nothing depends on roll and pitch, so that the papers' six velocities are a closed system.
"""
COUNTS = {"velocities": 6, "motion": 8, "navigation": 12}


class PrintedRow(NamedTuple):
    """One filter on one path."""

    rmse: Mapping[str, float]  # by component of the pose: x, y, z [m], psi [rad]; not every table has all
    seconds: float
    final_percent: Mapping[str, float] = {}  # error at the end over the path's end, it seems


class PrintedPath(NamedTuple):
    """Ensemble and fuzzy Kalman filter on one path."""

    enkf: PrintedRow
    fkf: PrintedRow
    remark: str = ""  # misprint, or how it was interpreted


class Paper(NamedTuple):
    """A source with remarks for its readers."""

    name: str
    source: str
    remarks: tuple[str, ...]


def papers_model(states: str, world: str = "vehicle", **arguments) -> StateSpaceModel:
    """The model of so many states at the papers' noise and sensors, u, v, w and r measured at every step of 1 ms.

    Process noise is on velocities, as in the papers, and very small on roll and pitch; yaw and position have none.
    The inputs are X_prop, K_prop, delta_s and delta_r, and for "velocities" also roll and pitch.

    Args:
        states: "velocities", "motion" or "navigation".
        world: one of `WORLDS`.
        **arguments: others of `thruster_env.auv.model.auv_model`.

    Raises:
        ValueError: for an unknown world, and as `auv_model` does.
    """
    noise = (NOISE,) * 6 + (ANGLE_NOISE**2,) * 2 + (0.0,) * 4
    settings: dict[str, Any] = {
        "preset": WORLDS[one_of("world", world, tuple(WORLDS))],
        "dt": DT,
        "propeller_torque": None,
        "sensors": MEASURED,
        "measurement_noise_cov": (NOISE,) * len(MEASURED),
        "initial_state": {"mean": (0.0,) * 12, "cov": [deviation**2 for deviation in START]},
        "process_noise_cov": noise[: COUNTS[one_of("states", states, tuple(COUNTS))]],
    }
    return auv_model(states=states, **settings | arguments)


# Ngatini, E. Apriliani, H. Nurhadi (2017), "Ensemble and Fuzzy Kalman Filter for position estimation of an
# autonomous underwater vehicle based on dynamical system of AUV motion", Expert Systems with Applications 68,
# 29-35. The numbers are those of Ngatini's slides on the same comparison; the article itself was not at hand.


PRINTED_MEMBERS = 50  # beside the 64 rules of the fuzzy filter

PRINTED_PATHS = {
    "dynamic": PrintedPath(
        PrintedRow(
            {"x": 0.00152, "y": 0.00138, "psi": 0.001123},
            1.68838,
            {"x": 0.00152, "y": 0.00138, "psi": 0.001123},
        ),
        PrintedRow(
            {"x": 0.01981, "y": 0.01778, "psi": 0.002287},
            3.3382,
            {"x": 0.01981, "y": 0.01778, "psi": 0.002287},
        ),
        "the percents are the digits of the RMSE: a copy",
    ),
    "I": PrintedPath(
        PrintedRow({"x": 0.03953, "y": 0.00814, "psi": 0.002008}, 2.91739, {"x": 0.43, "y": 0.85}),
        PrintedRow({"x": 0.044275, "y": 0.001251, "psi": 1.99e-5}, 3.496043, {"x": 0.98, "y": 3.31}),
    ),
    "II": PrintedPath(
        PrintedRow({"x": 0.0553, "z": 0.0077, "psi": 0.0427}, 2.983, {"x": 0.087, "z": 2.41}),
        PrintedRow({"x": 0.0334, "z": 0.0031, "psi": 0.00204}, 3.231, {"x": 0.171, "z": 1.49}),
    ),
    "III": PrintedPath(
        PrintedRow({"x": 0.009, "y": 0.0044, "psi": 0.005}, 2.642, {"x": 0.977, "y": 4.86}),
        PrintedRow({"x": 0.00045, "y": 0.00046, "psi": 1e-5}, 3.5532, {"x": 0.928, "y": 0.83}),
    ),
    "IV": PrintedPath(
        PrintedRow(
            {"x": 0.47017, "y": 0.467, "z": 0.082, "psi": 0.10039},
            2.8194,
            {"x": 0.454, "y": 4.834, "z": 3.525},
        ),
        PrintedRow(
            {"x": 0.3747, "y": 0.3662, "z": 0.0188, "psi": 0.100388},
            3.80326,
            {"x": 0.661, "y": 4.089, "z": 0.886},
        ),
        "the EnKF's row is that of ngatini2019 for 50 members",
    ),
}
"""By the name of the path. That the angle is yaw is inferred, and so is what paths I to III are."""

NGATINI2017 = Paper(
    name="ngatini2017",
    source="Ngatini, E. Apriliani, H. Nurhadi (2017), Expert Systems with Applications 68, 29-35, by their slides",
    remarks=(
        "Not fully specified: what the matrices of a rule are, whether a tangent has its offset, how a rule's "
        "weight follows from six memberships, and whether a rule continues from its own estimate or the common "
        "one. Here each rule is the tangent at its corner at cruise, its weight the product of memberships within "
        "0 and 1, and all continue from the common estimate.",
        "Memberships of minimum and maximum are exchanged in name, and both are called mu_u1.",
        "B_3 keeps the term m dw/dt within the bracket, though dw/dt stands on the left.",
        "The matrix E is printed with 8 columns, on one slide with 7. It is 6 x 6.",
        "The gain is printed as P H' (H P + R)^-1. It is P H' (H P H' + R)^-1.",
        "The input vector lists both planes twice.",
        "The RMSE of the dynamic path are printed again as percents, and conclusion 4 has other percents.",
        "M_uu_dr in the equation of yaw stands for N_uu_dr.",
        "Row 5 of the mass matrix has -(M_wd + x_G) for -(M_wd + m x_G).",
    ),
)


# Ngatini, H. Nurhadi (2019), "Estimasi Lintasan AUV 3 Dimensi (3D) Dengan Ensemble Kalman Filter", Jurnal Inovtek
# Polbeng Seri Informatika 4(1), 12-21, ISSN 2527-9866.


TABLE_III = {
    50: PrintedRow({"x": 0.4702, "y": 0.4674, "z": 0.0823, "psi": 0.1003}, 2.819),
    100: PrintedRow({"x": 0.4636, "y": 0.4666, "z": 0.0819, "psi": 0.1003}, 5.692),
    200: PrintedRow({"x": 0.4648, "y": 0.4657, "z": 0.0814, "psi": 0.1003}, 11.56),
    300: PrintedRow({"x": 0.4632, "y": 0.4644, "z": 0.0820, "psi": 0.1003}, 18.15),
}
"""By the number of members. That the angle is yaw is inferred."""

NGATINI2019 = Paper(
    name="ngatini2019",
    source="Ngatini, H. Nurhadi (2019), Jurnal Inovtek Polbeng Seri Informatika 4(1), 12-21",
    remarks=(
        "Equation (24) moves the mean, and no member: every forecast member is f(mean) plus noise, whose "
        "covariance is Q whatever the measurements said. The slides of ngatini2017 move the members.",
        "The text has an accuracy above 55 %, without a definition: it cannot be reproduced.",
        "The seconds are linear in the number of members, 0.056 to 0.061 s each, so members were looped over. "
        "At 0.001 s a step a path of 18 m takes some 20 000 steps, which would leave 3 us of Octave for the "
        "dozen statements of a member's step: the run was probably shorter than the path.",
        "The printed A^-1 is no vehicle's: its inverse has eigenvalues of both signs.",
        "Table and text have 11.56 and 11.57 s for 200 members.",
        "Abstract and conclusion give the error of an angle in metres, and initial angles come in rad/s.",
        "Equations (1) to (4) have lost the dots of derivatives; Z_uu delta_s in (7) lacks u^2.",
        "M_uu_dr in (10) and (17) stands for N_uu_dr, and the last bracket of (17) has the other sign.",
        "Row 5 of (11) has -(M_wd + x_G) for -(M_wd + m x_G).",
        "The gain is printed as P H' (H P + R)^-1. It is P H' (H P H' + R)^-1.",
        "The body's origin is said to be in the earth's centre of gravity.",
    ),
)
