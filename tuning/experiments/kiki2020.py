"""RMSE of KF and EnKF on the linear bow thruster, as printed by Kiki (2020).

Source: M. Kiki (2020), final project KM184801, Department of Mathematics, Institut Teknologi Sepuluh
Nopember, Surabaya (in Indonesian). One run of 100 steps of 0.01 s, it seems; x_0, P_0, V_s, U_0 and the
ensemble size are not printed.
"""

from tuning.experiments.published import PublishedRMSE, PublishedTable

TABLE = PublishedTable(
    name="kiki2020",
    source="M. Kiki (2020), final project KM184801, Institut Teknologi Sepuluh Nopember, Surabaya",
    kf={
        ("tunnel", 0.5): PublishedRMSE(0.8740, 0.9239, "the text has 0.9232 for U_a", (0.8740, 0.9232)),
        ("tunnel", 0.6): PublishedRMSE(1.0138, 1.0093),
        ("tunnel", 0.8): PublishedRMSE(1.1386, 1.1429),
        ("tunnel", 1.0): PublishedRMSE(1.3290, 1.3297),
        ("open-bladed", 0.5): PublishedRMSE(2.7060, 1.9870, "the text has 2.7061 for omega_m", (2.7061, 1.9870)),
        ("open-bladed", 0.6): PublishedRMSE(2.0609, 2.0609, "one value twice; the text has 2.0690"),
        ("open-bladed", 0.8): PublishedRMSE(1.9957, 2.6939, "the text has 2.6821 for omega_m", (2.6821, 2.6939)),
        ("open-bladed", 1.0): PublishedRMSE(2.7525, 2.7646),
    },
    enkf={
        ("tunnel", 0.5): PublishedRMSE(0.7920, 0.1352),
        ("tunnel", 0.6): PublishedRMSE(0.8941, 0.1492),
        ("tunnel", 0.8): PublishedRMSE(1.0355, 0.1724),
        ("tunnel", 1.0): PublishedRMSE(1.2331, 0.2055),
        ("open-bladed", 0.5): PublishedRMSE(3.6437, 0.6529),
        ("open-bladed", 0.6): PublishedRMSE(4.4253, 0.6759),
        ("open-bladed", 0.8): PublishedRMSE(5.2090, 0.8666),
        ("open-bladed", 1.0): PublishedRMSE(5.7886, 0.9631),
    },
    remarks=(
        "Equation 4.50 as printed starts every member again from the mean: the ensemble forgets its spread.",
        "Section 4.6 prints R where R^-1 belongs.",
        "The KF's 1.9957 stands in one cell only (open-bladed, q = 0.8) and is most likely a slip: the text to "
        "its figure has 2.6821, so that the pair would be 2.6821 and 2.6939.",
        "The abstract quotes this 1.9957 together with 2.0609, from two different rows (q = 0.8 and q = 0.6), as "
        "that of Nurhadi et al. (2022) does: they are no run.",
        "Observability is tested with the measurement matrix [0 1], but the observability matrix printed is that "
        "of [1 0]. The runs have neither: H = [-2.03 -12.2].",
        "The eigenvalue 3.1872 of the open-bladed system is printed 31872, and its characteristic polynomial has "
        "528.83 where the trace gives 523.83.",
        "The derivative of dU_a/dt by U_0 is printed as -2 (K4/K3) U_0; the equation gives 2 (K4/K3) |U_a - U_0|.",
    ),
)
