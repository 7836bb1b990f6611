"""Problems of the methods' tests: runs drawn in NumPy, whose filters are those of textbooks."""

import numpy as np

from filters import affine_model
from tuning.methods.task import Task
from tuning.problems.model_problem import RunsProblem

A = np.array([[1.0, 0.3], [0.0, 0.9]])
C = np.array([[1.0, 0.0], [0.5, 1.0]])
Q, R = np.diag([0.05, 0.2]), np.diag([0.4, 0.1])
P0 = np.diag([1.0, 0.5])


def root_of(cov):
    """The matrix M by which NumPy's `multivariate_normal` multiplies a row of normals: M' M = cov."""
    _, variances, axes = np.linalg.svd(np.asarray(cov))
    return np.sqrt(variances)[:, None] * axes


def drawn(a, c, q, r, p0, steps, runs, seed, missing=0.0):
    """Runs of a linear model as mappings of measurements and states."""
    rng = np.random.default_rng(seed)
    of_start, of_state, of_sensor = (root_of(cov) for cov in (p0, q, r))
    found = []
    for _ in range(runs):
        x = rng.standard_normal(len(a)) @ of_start
        states, seen = [], []
        for _ in range(steps + 1):
            states.append(x)
            seen.append(c @ x + rng.standard_normal(len(c)) @ of_sensor)
            x = a @ x + rng.standard_normal(len(a)) @ of_state
        z = np.array(seen)
        z[rng.random(z.shape) < missing] = np.nan
        found.append({"measurements": z, "states": np.array(states)})
    return found


def linear(a=A, c=C, q=Q, r=R, p0=P0, steps=60, runs=4, seed=0, missing=0.0, truth=True, **options):
    """A `RunsProblem` whose training runs are all that are drawn but two, and whose model is the plant's."""
    some = drawn(a, c, q, r, p0, steps, runs + 2, seed, missing)
    if not truth:
        some = [{"measurements": one["measurements"]} for one in some]
    model = affine_model(A=a, C=c, Q=q, R=r, P0=p0)
    given = {"scale": (1.0,) * len(a)} if truth else {}
    return RunsProblem(some, model, held_out=[runs, runs + 1], name="a linear model", **(given | options))


def task_of(problem, runs=4, filter_name="kf", **options):
    """A task on the first runs of a problem."""
    return Task(filter_name, problem, problem.data(range(runs)), **options)


def at(task, q, r):
    """The start of a task with other diagonals of Q and R."""
    numbers = {"process_noise_cov": tuple(q), "measurement_noise_cov": tuple(r) if len(r) > 1 else float(r[0])}
    return task.start._replace(model={**task.start.model, **numbers})
