"""Five masses in a chain of springs: ten states, three displacements measured, one force known.

    m q_i'' = k_i (q_{i-1} - q_i) + k_{i+1} (q_{i+1} - q_i) - d q_i' + [i = 1] u + f_i,   q_0 = q_6 = 0

What I had: a full Q of the unknown forces f_i, held over a step, of 2 N each: five noises for ten states, so Q
is singular; and the R of the data sheet, 5 mm, which is right. In the plant the unknown forces are 0.5 N, and
the third spring is 15 % softer than the model believes.

Source: the equation is any textbook's (L. Meirovitch (2001), Fundamentals of Vibrations); its numbers are those
of a bench with masses of 1 kg.
"""

import numpy as np
from scipy.linalg import expm

from filters import affine_model
from tuning.problems.model_problem import ModelProblem

DT, MASSES = 0.02, 5  # [s]
MASS, STIFFNESS, DAMPING = 1.0, 200.0, 0.4  # [kg], [N/m], [N s/m]


def equations(softer=1.0):
    """A (10, 10) and B (10, 5) of x' = A x + B f for displacements and speeds, the third spring times a factor."""
    springs = np.full(MASSES + 1, STIFFNESS)
    springs[2] *= softer
    k = np.diag(springs[:-1] + springs[1:]) - np.diag(springs[1:-1], 1) - np.diag(springs[1:-1], -1)
    eye, zero = np.eye(MASSES), np.zeros((MASSES, MASSES))
    a = np.block([[zero, eye], [-k / MASS, -DAMPING / MASS * eye]])
    return a, np.vstack([zero, eye / MASS])


def over_a_step(softer=1.0):
    """The same over a step in which forces stand still: x_{k+1} = A x_k + B f_k, exactly."""
    a, b = equations(softer)
    whole = expm(DT * np.block([[a, b], [np.zeros((MASSES, 3 * MASSES))]]))
    return whole[: 2 * MASSES, : 2 * MASSES], whole[: 2 * MASSES, 2 * MASSES :]


def model(softer, force, gauge):
    """The chain with a third spring of a factor, unknown forces [N] and gauges [m] of some deviation."""
    a, b = over_a_step(softer)
    return affine_model(
        a=a,
        b=b[:, :1],
        c=np.eye(2 * MASSES)[[0, 2, 4]],
        process_noise_cov=force**2 * b @ b.T,
        measurement_noise_cov=[gauge**2] * 3,
        prior_mean=np.zeros(2 * MASSES),
        prior_cov=[1e-4] * MASSES + [1e-2] * MASSES,
        states=[(f"displacement {i}", f"q_{i}", "m") for i in range(1, MASSES + 1)]
        + [(f"speed {i}", f"v_{i}", "m/s") for i in range(1, MASSES + 1)],
        input_quantities=[("force", "u", "N")],
        measurements=[(f"gauge {i}", f"z_{i}", "m") for i in (1, 3, 5)],
    )


problem = ModelProblem(
    model(softer=0.85, force=0.5, gauge=5e-3),
    model(softer=1.0, force=2.0, gauge=5e-3),
    inputs={"name": "steps", "amplitude": 20.0, "hold": 40},
    steps=300,
    dt=DT,
    scale=(2e-3,) * MASSES + (0.03,) * MASSES,
    name="chain",
    about="five masses and springs, three gauges; a spring is softer than believed, Q is full and singular",
)
