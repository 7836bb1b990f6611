"""RMSE of KF and EnKF on the linear bow thruster, as printed by Nurhadi et al. (2022).

Source: H. Nurhadi, M. Kiki, D. Adzkiya, T. Herlambang (2022), "Estimation of water momentum and propeller
velocity in bow thruster model of autonomous surface vehicle using modified Kalman filter", International
Journal of Electrical and Computer Engineering (IJECE) 12(6), 5988-5997,
doi:10.11591/ijece.v12i6.pp5988-5997. One run of 100 steps of 0.01 s, it seems; x_0, P_0, V_s, U_0 and the
ensemble size are not printed.
"""

from tuning.experiments.published import PublishedRMSE, PublishedTable

TABLE = PublishedTable(
    name="nurhadi2022",
    source="H. Nurhadi, M. Kiki, D. Adzkiya, T. Herlambang (2022), IJECE 12(6), 5988-5997",
    kf={
        ("tunnel", 0.5): PublishedRMSE(0.8678, 0.8717),
        ("tunnel", 0.6): PublishedRMSE(1.0751, 1.0804),
        ("tunnel", 0.8): PublishedRMSE(1.1638, 1.1598),
        ("tunnel", 1.0): PublishedRMSE(1.1969, 1.8830),
        ("open-bladed", 0.5): PublishedRMSE(1.6749, 1.6820),
        ("open-bladed", 0.6): PublishedRMSE(1.7762, 1.7748),
        ("open-bladed", 0.8): PublishedRMSE(1.8369, 1.8449),
        ("open-bladed", 1.0): PublishedRMSE(2.2645, 2.2752),
    },
    enkf={
        ("tunnel", 0.5): PublishedRMSE(0.8051, 0.1344),
        ("tunnel", 0.6): PublishedRMSE(0.8051, 0.1344, "a copy of the row q = 0.5"),
        ("tunnel", 0.8): PublishedRMSE(0.9951, 0.1659),
        ("tunnel", 1.0): PublishedRMSE(1.2049, 0.2017),
        ("open-bladed", 0.5): PublishedRMSE(4.0858, 0.6795),
        ("open-bladed", 0.6): PublishedRMSE(4.1879, 0.6980),
        ("open-bladed", 0.8): PublishedRMSE(5.0252, 0.8365),
        ("open-bladed", 1.0): PublishedRMSE(5.8559, 0.9749),
    },
    remarks=(
        "P_xz and P_z as printed use the perturbed measurements in place of the predicted ones.",
        "The gain K as printed lacks H': it is P H' (H P H' + R)^-1.",
        "The abstract's EnKF values 0.7920 and 0.1352 stand in the table of Kiki (2020), not in this "
        "paper's. Its KF values 1.9957 and 2.0609 come from there too, from two different rows (q = 0.8 and "
        "q = 0.6): they are no run. And 1.9957 is most likely a slip for 2.6821, which the text there has.",
        "The eigenvalue 3.1872 of the open-bladed system is printed 31872, and its characteristic polynomial has "
        "528.83 where the trace gives 523.83.",
        "B of the open-bladed system is printed with 0.065 for 0.65: the printed B_d follows from 0.65 only.",
        "The conclusion contradicts the paper's own Table 2. By the printed numbers the EnKF's error of omega_m "
        "in the open-bladed case is 2.4 to 2.7 times the KF's.",
    ),
)
