"""The linear and the chaotic setting in which KalmanNet was published.

Linear: F = [[1, 1], [0, 1]], H = [[1, 1], [1, 0]]. Lorenz-63, with dx/dt = A(x) x, A(x) = [[-10, 10, 0],
[28, -1, -x_1], [0, x_1, -8/3]]: a step of 0.02 s is x' = (sum over j <= 5 of (0.02 A(x))^j/j!) x, and all of x is
measured. Both have Q = q^2 I and R = r^2 I with q^2/r^2 = 0.01, and start from a known state. Runs have 100 steps;
the papers' figure is the mean square error over states, steps and runs in dB.

    thruster train-estimator kalmannet --problem tuning.experiments.kalmannet:lorenz

Source: Revach et al. (2022), "KalmanNet: Neural Network Aided Kalman Filtering for Partially Known Dynamics",
IEEE Transactions on Signal Processing 70, sections IV-B and IV-D.
"""

from __future__ import annotations

from filters import StateSpaceModel
from tuning.problems.model_problem import ModelProblem

STEPS, DT, ORDER = 100, 0.02, 5
RATIO = 0.01  # q^2/r^2, -20 dB


def move(x, u, c):
    """One step of the linear model."""
    return x[0] + x[1], x[1]


def see(x, c):
    """Both sums that the linear model's sensors measure."""
    return x[0] + x[1], x[0]


def chaotic(x, u, c):
    """One step of Lorenz-63: the exponential of A(x) up to its fifth power."""
    first = x[0]
    term, total = x, x
    for j in range(1, ORDER + 1):
        a, b, d = term
        part = DT / j
        term = (
            part * (10.0 * (b - a)),
            part * (28.0 * a - b - first * d),
            part * (first * b - 8.0 / 3.0 * d),
        )
        total = (total[0] + term[0], total[1] + term[1], total[2] + term[2])
    return total


def everything(x, c):
    """All states."""
    return x[0], x[1], x[2]


def problem_of(transition, observe, start: tuple[float, ...], r2: float, name: str) -> ModelProblem:
    """A problem of runs that start from a known state, with R = r2 I; all steps are scored alike."""
    n = len(start)
    model = StateSpaceModel(
        transition=transition,
        observe=observe,
        process_noise_cov=[RATIO * r2] * n,
        measurement_noise_cov=[r2] * n,
        prior_mean=start,
        prior_cov=[0.0] * n,
        inputs=0,
        analytic=True,
    )
    about = "a setting of the paper on KalmanNet"
    return ModelProblem(
        model, steps=STEPS, first_scored_step=0, scale=[r2**0.5] * n, name=name, about=about, dt=DT
    )


linear = problem_of(move, see, (1.0, 0.0), 1.0, "linear")
lorenz = problem_of(chaotic, everything, (1.0, 1.0, 1.0), 1.0, "lorenz")
