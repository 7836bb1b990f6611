"""Ensemble and fuzzy Kalman filter on five paths of an underwater vehicle, as printed in the authors' slides.

Source: Ngatini, E. Apriliani, H. Nurhadi (2017), "Ensemble and Fuzzy Kalman Filter for position estimation of an
autonomous underwater vehicle based on dynamical system of AUV motion", Expert Systems with Applications 68, 29-35.
The numbers are those of Ngatini's slides on the same comparison; the article itself was not at hand. The EnKF has
50 members, the fuzzy filter 64 rules.
"""

from tuning.experiments.vehicle.models import Paper, PrintedPath, PrintedRow

MEMBERS, RULES = 50, 64

PATHS = {
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

DYNAMIC_FINAL_PERCENT = {"x": 0.032, "y": 0.051, "z": 0.0768}  # conclusion 4, where the table has other numbers

PAPER = Paper(
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
