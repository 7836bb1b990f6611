"""The ensemble Kalman filter of an underwater vehicle's path over the number of members, as printed.

Source: Ngatini, H. Nurhadi (2019), "Estimasi Lintasan AUV 3 Dimensi (3D) Dengan Ensemble Kalman Filter", Jurnal
Inovtek Polbeng Seri Informatika 4(1), 12-21, ISSN 2527-9866.
"""

from tuning.experiments.vehicle.models import Paper, PrintedRow

PARTICULARS = {
    "mass": (15.0, "kg"),
    "length": (0.98, "m"),
    "beam": (0.188, "m"),
    "propeller diameter": (0.040, "m"),
    "battery": (11.8, "V"),
    "motor": (12.0, "V"),
    "speed": (1.94, "kn"),
}
"""Table I, as far as it has numbers."""

SETTINGS = {
    "dt [s]": 0.001,
    "delta_r [deg]": 5.0,
    "members": (50, 100, 200, 300),
    "runs": 10,
    "software": "Octave 4.2.2",
}

TABLE_III = {
    50: PrintedRow({"x": 0.4702, "y": 0.4674, "z": 0.0823, "psi": 0.1003}, 2.819),
    100: PrintedRow({"x": 0.4636, "y": 0.4666, "z": 0.0819, "psi": 0.1003}, 5.692),
    200: PrintedRow({"x": 0.4648, "y": 0.4657, "z": 0.0814, "psi": 0.1003}, 11.56),
    300: PrintedRow({"x": 0.4632, "y": 0.4644, "z": 0.0820, "psi": 0.1003}, 18.15),
}
"""By the number of members. That the angle is yaw is inferred."""

IN_TEXT = {"x": 0.4, "y": 0.46, "z": 0.08, "psi": 0.1}
END = {"x": 10.0, "y": 18.0, "z": 6.0}  # of the path [m]
FINAL_GAP = {"x": 0.02, "y": 0.9, "z": 0.2}  # between path and estimate at the end [m]
FINAL_PERCENT = {"x": 0.454, "y": 4.834, "z": 3.525}  # in the slides of ngatini2017

PAPER = Paper(
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
