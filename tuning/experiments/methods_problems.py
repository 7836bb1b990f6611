"""The problems of the study, in groups: what is known of the model decides which method is good."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np

from filters import affine_model
from tuning.experiments import lorenz96
from tuning.experiments.benchmark import noise_free_problem
from tuning.experiments.lidar import drawn, lidar_problem
from tuning.experiments.pendulum import model as pendulum
from tuning.methods.task import ALONE
from tuning.problems.excitation import Steps
from tuning.problems.find import find_problem
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Problem

NOTHING: Mapping[str, bool] = {}
FULL: Mapping[str, bool] = {"full_q": True, "full_r": True}
FULL_Q: Mapping[str, bool] = {"full_q": True}
HELD_R: Mapping[str, bool] = {"hold_r": True}
LIDAR_RUNS, LIDAR_SETS = 700, 20  # that are held out, and sets of runs to learn from
MASSES, STIFFNESS, DAMPING, DT = 5, 200.0, 0.4, 0.02  # of a chain, each mass 1 kg
GROUPS = {
    "A": "linear, right",
    "B": "nonlinear, right",
    "C": "wrong model",
    "D": "outliers and a dead band",
    "E": "small ensembles",
    "F": "eight to ten states",
    "G": "no truth to learn from",
    "H": "little data",
}
RUNS, SECONDS = (1e3, 1e4, 1e5), (1.0, 10.0, 100.0)  # budgets
STARTS = ((1.0, 1.0), (100.0, 1.0), (0.01, 100.0))  # factors on the rule of thumb's Q and R, by turns of data sets
REFERENCE = "reference"  # the best constant numbers
START, SCALED, ORACLE = "start", "scaled default", "oracle"
STUDY, STUDY_LOG_SCORE = "study", "study of log-score"  # of 50 trials, as `thruster tune` makes them
TRIALS = 50
WITH_FULL = ", full"  # behind a method: it tunes full Q and R, where the others of a case tune diagonals
FROM_NOISE = ", full, from noise estimation"  # the same, and begins there: added after the first results


class Case(NamedTuple):
    """A filter to be tuned on runs of a problem."""

    name: str
    group: str
    make: Callable[[], Problem]
    filter: str
    options: Mapping[str, bool] = NOTHING
    runs: int = 32  # to learn from, in a data set
    members: int | None = None  # of an ensemble
    truth: bool = True  # whether they have true states
    about: str = ""

    @property
    def model(self) -> str:
        """A name of the filter and what it is of, which cases that differ in their data alone share."""
        return f"{self.name.split(',')[0]} {self.filter}"


@cache
def walk() -> Problem:
    """A level that wanders."""
    unit = np.eye(1)
    noise = {"process_noise_cov": [1.0], "measurement_noise_cov": 4.0}
    model = affine_model(a=unit, b=np.zeros((1, 0)), c=unit, prior_mean=[0.0], prior_cov=[4.0], **noise)
    untuned = {"process_noise_cov": (0.01,), "measurement_noise_cov": 4.0}
    return ModelProblem(
        model, steps=300, untuned=untuned, name="walk", about="a level that wanders, seen with noise"
    )


@cache
def velocity() -> Problem:
    """Motion in a plane at nearly constant velocity."""
    model = affine_model(
        a=np.eye(4) + np.eye(4, k=2),
        b=np.zeros((4, 0)),
        c=np.eye(2, 4),
        process_noise_cov=[0.02, 0.05, 0.01, 0.03],
        measurement_noise_cov=[4.0, 1.0],
        prior_mean=[0.0] * 4,
        prior_cov=[10.0, 10.0, 1.0, 1.0],
    )
    untuned = {"process_noise_cov": (1.0,) * 4, "measurement_noise_cov": (1.0, 1.0)}
    about = "motion in a plane at nearly constant velocity, both positions measured"
    return ModelProblem(model, steps=300, untuned=untuned, name="velocity", about=about)


@cache
def swing() -> Problem:
    """Gymnasium's pendulum, drawn from the model that filters assume."""
    true = pendulum(0.3)
    untuned = {"process_noise_cov": (1e-3, 1e-1), "measurement_noise_cov": (0.01, 0.01, 0.25)}
    push = Steps(amplitude=2.0, hold=20)
    name = "pendulum"
    return ModelProblem(
        true, true, push, steps=300, dt=0.05, untuned=untuned, name=name, about="a pendulum, right"
    )


@cache
def chain() -> Problem:
    """Five masses in a chain of springs, whose model is right: thirteen numbers."""
    from scipy.linalg import expm

    k = 2.0 * STIFFNESS * np.eye(MASSES) - STIFFNESS * (np.eye(MASSES, k=1) + np.eye(MASSES, k=-1))
    eye, zero = np.eye(MASSES), np.zeros((MASSES, MASSES))
    a = np.block([[zero, eye], [-k, -DAMPING * eye]])
    b = np.vstack([zero, eye])[:, :1]
    discrete = expm(DT * np.block([[a, b], [np.zeros((1, 2 * MASSES + 1))]]))
    n = 2 * MASSES
    model = affine_model(
        a=discrete[:n, :n],
        b=discrete[:n, n:],
        c=np.eye(n)[[0, 2, 4]],
        process_noise_cov=[1e-6] * MASSES + [1e-4, 4e-4, 1e-4, 1e-3, 1e-4],
        measurement_noise_cov=[2.5e-5, 1e-4, 2.5e-5],
        prior_mean=np.zeros(n),
        prior_cov=[1e-4] * MASSES + [1e-2] * MASSES,
    )
    untuned = {"process_noise_cov": (1e-5,) * MASSES + (1e-3,) * MASSES, "measurement_noise_cov": (1e-4,) * 3}
    push = Steps(amplitude=20.0, hold=40)
    about = "five masses and springs, ten states, three displacements measured: thirteen numbers"
    return ModelProblem(model, model, push, steps=300, dt=DT, untuned=untuned, name="chain", about=about)


@cache
def targets() -> Problem:
    """A target in a plane and another one beside it, whose noise goes together: Q has two full blocks.

    A velocity that wanders for a time T = 1 with the intensity S moves the position, too:
    Q = (T^3/3 S, T^2/2 S; T^2/2 S, T S), van Loan's integral.
    """
    motion, eye = np.eye(4) + np.eye(4, k=2), np.eye(2, 4)
    times = np.array([[1.0 / 3.0, 0.5], [0.5, 1.0]])
    intensities = np.array([[0.10, 0.06], [0.06, 0.05]]), np.array([[0.02, -0.01], [-0.01, 0.04]])
    q = np.zeros((8, 8))
    q[:4, :4], q[4:, 4:] = (np.kron(times, intensity) for intensity in intensities)
    model = affine_model(
        a=np.kron(np.eye(2), motion),
        b=np.zeros((8, 0)),
        c=np.block([[eye, np.zeros((2, 4))], [-eye, eye]]),
        process_noise_cov=q,
        measurement_noise_cov=[4.0, 1.0, 0.25, 0.25],
        prior_mean=np.zeros(8),
        prior_cov=[10.0, 10.0, 1.0, 1.0] * 2,
    )
    untuned = {"process_noise_cov": (0.1,) * 8, "measurement_noise_cov": (1.0,) * 4}
    about = "a target and another one seen from it, eight states; Q has two full blocks: forty numbers"
    return ModelProblem(model, steps=300, untuned=untuned, name="targets", about=about)


@cache
def ring(steps: int = 300) -> Problem:
    """Lorenz-96, where twenty members need some inflation; in the first half of a run it reaches its attractor."""
    arguments: dict[str, Any] = {"scale": np.ones(lorenz96.STATES), "dt": lorenz96.SUBSTEP}
    return noise_free_problem(
        lorenz96.model(), steps=steps, first_scored_step=steps // 2, about="Lorenz-96", **arguments
    )


@cache
def lidar() -> Problem:
    """OKF's lidar: twenty sets of 32 runs to learn from, and others that are held out."""
    return lidar_problem(drawn(LIDAR_SETS * 32 + LIDAR_RUNS), LIDAR_RUNS)


def problem_named(name: str) -> Callable[[], Problem]:
    """A problem by its name."""
    return partial(find_problem, name)  # which another process can be sent


CASES = (
    Case("walk", "A", walk, "kf"),
    Case("velocity", "A", velocity, "kf"),
    Case("published_tunnel", "A", problem_named("published_tunnel"), "kf"),
    Case("nominal", "B", problem_named("nominal"), "ekf"),
    Case("pendulum", "B", swing, "ekf"),
    Case("mismatch", "C", problem_named("mismatch"), "ekf"),
    Case("ambient", "C", problem_named("ambient"), "ekf"),
    Case("lidar", "C", lidar, "kf", FULL),
    Case("outliers", "D", problem_named("outliers"), "ekf"),
    Case("deadband", "D", problem_named("deadband"), "ekf"),
    Case("nominal, N = 10", "E", problem_named("nominal"), "enkf", members=10),
    Case("lorenz96, N = 20", "E", ring, "etkf", HELD_R, 16, 20),
    Case("chain", "F", chain, "kf"),
    Case("targets", "F", targets, "kf", FULL_Q),
    Case("auv:motion", "F", problem_named("auv:motion"), "ekf"),
    Case("nominal, blind", "G", problem_named("nominal"), "ekf", truth=False),
    Case("mismatch, blind", "G", problem_named("mismatch"), "ekf", truth=False),
    *(Case(f"nominal, {runs} runs", "H", problem_named("nominal"), "ekf", runs=runs) for runs in (1, 3, 10)),
    *(Case(f"velocity, {runs} runs", "H", velocity, "kf", runs=runs) for runs in (1, 3, 10)),
)
QUICK = (Case("walk", "A", walk, "kf", runs=4), Case("walk, blind", "G", walk, "kf", runs=4, truth=False))


FULL_METHODS = (
    *(f"{method}{WITH_FULL}" for method in ("mse", "log-score", "likelihood", "als")),
    *(f"{method}{FROM_NOISE}" for method in ("mse", "log-score")),
)
ENTRIES = (*ALONE, *FULL_METHODS, START, SCALED, ORACLE, STUDY, STUDY_LOG_SCORE)


class Protocol(NamedTuple):
    """How much is done."""

    cases: tuple[Case, ...] = CASES
    methods: tuple[str, ...] = ENTRIES
    sets: int = 20
    runs: float = max(RUNS)
    seconds: float = max(SECONDS)
    held_out: int = 200
    many: int = 2000  # runs for the reference ...
    starts: int = 20  # ... and its starts


FAST = Protocol(
    QUICK, ("likelihood", "log-score", "em", "noise-estimation", "random-only", START), 3, 200, 2.0, 20, 20, 2
)


class Prediction(NamedTuple):
    """A statement that the study can contradict, written before its first run."""

    who: str
    says: str


PREDICTIONS = (
    Prediction("Greenberg et al. (OKF)", "Adam on the error beats noise estimation wherever the model is wrong."),
    Prediction("Abbeel et al.", "The log score beats likelihood and noise estimation on real error."),
    Prediction("Chen et al.", "A consistent NIS finds Q and R, and no local minimum holds it."),
    Prediction("Rawlings et al.", "ALS equals maximum likelihood on long runs of a linear model."),
    Prediction("Dunik et al.", "Likelihood is the most accurate, correlation methods 10 to 100 times faster."),
    Prediction("Durbin, Koopman", "Maximum likelihood is efficient where the model is right."),
    Prediction("Shumway, Stoffer", "EM ends where maximum likelihood ends, slowly."),
    Prediction("Sarkka, Nummenmaa", "A converged adaptive filter loses 1 to 3 % on constant noise."),
    Prediction(
        "Desroziers et al.", "Innovations tell R and a factor on Q within 2 % of the best, without a search."
    ),
    Prediction("The MathWorks", "A step up or half of it, a number at a time, is enough."),
    Prediction("we", "A model that is right: noise estimation is best and free."),
    Prediction(
        "we", "A model that is right, one to three runs: likelihood beats tuning on truth of the same runs."
    ),
    Prediction("we", "From ten numbers on, gradients beat samplers by 5 % in a tenth of the time."),
    Prediction("we", "The log score is within 2 % of the least error, with a NEES near 1, everywhere."),
    Prediction("we", "Methods without truth lose less than 5 % but on wrong models."),
    Prediction("we", "Random search within 1e4 runs is beaten by every search but coordinate steps."),
)
