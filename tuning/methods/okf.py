"""OKF, Adam on the Cholesky factors of Q and R by batches of runs, on the squared error of the true states."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from tuning.evaluation.baselines import with_covariances
from tuning.likelihood.gradient import objective_of
from tuning.likelihood.objective import Objective
from tuning.methods.scoring import noise_estimation
from tuning.methods.task import FEW, Task
from tuning.problems.data import Data
from tuning.search.objectives import MSE
from tuning.search.space import Choice

RATE, HALVED_EVERY, CLIP = 1e-2, 150, 1.0  # of Adam: steps, and the largest norm of a gradient
BATCH, VALIDATION = 10, 0.15  # runs of a step, and the part of all runs that chooses among steps
LOOKED_EVERY, PATIENCE = 30, 8  # steps between validations, and those without gain that end it
MOST = 600  # steps
RIDGE = 1e-6  # added to the variances of the first Q and R
MEAN, SQUARE, TINY = 0.9, 0.999, 1e-8  # of Adam's moments


def okf(task: Task) -> None:
    """Minimise the mean square error over L_Q and L_R, Q = L_Q L_Q', with exp(d) on the diagonals, by Adam.

    The start is noise estimation. A step is on a batch of ten runs; every 30 steps 15 % of the runs, which no
    step sees, say whether it has become better. The authors make one epoch of 700 runs or more; of fewer runs
    this makes as many epochs as it takes.

    Source: Greenberg, Yannay, Mannor (2023), "Optimization or architecture: how to hack Kalman filtering",
    NeurIPS; settings of their package. Kingma, Ba (2015), "Adam: a method for stochastic optimization", ICLR.
    """
    noise_estimation(task)
    order = [task.generator.permutation(len(runs.seeds)) for runs in task.data]
    held_out = [max(1, round(VALIDATION * len(indices))) if len(indices) > 1 else 0 for indices in order]
    validation = [
        _picked(data, indices[:count]) for data, indices, count in zip(task.data, order, held_out, strict=True)
    ]
    validation = [picked if picked.seeds else data for picked, data in zip(validation, task.data, strict=True)]
    learn = [indices[count:] for indices, count in zip(order, held_out, strict=True)]
    held_r = bool(task.options.get("hold_r"))
    few = task.goal(MSE, keeps=False).of_few(FEW)
    price = task.price("slopes of squares by Q and R", lambda: few.by_noise(task.best))
    least, waited = np.inf, 0
    for step, (choice, done) in enumerate(_adam(task, learn, held_r, price)):
        if step % LOOKED_EVERY == 0 or done:
            value = -_goal(task, choice, validation).by_noise(choice)[0]
            task.charge(price * sum(len(runs.seeds) for runs in validation))
            waited = waited + 1
            if value < least:
                least, waited = value, 0
                task.keep(choice)
            if waited > PATIENCE or done:
                return


def _adam(task: Task, learn: Sequence[np.ndarray], held_r: bool, price: float):
    """The choice before each step, and whether it is the last one."""
    model = task.model(task.best)
    factors = Factors(model.process_noise_cov, model.measurement_noise_cov)
    point = factors.first
    mean, square, queue = np.zeros_like(point), np.zeros_like(point), [np.zeros(0, dtype=int) for _ in learn]
    for step in range(MOST + 1):
        q, r = factors.matrices(point)
        choice = with_covariances(task.best if step else task.start, q, None if held_r else r)
        yield choice, step == MOST
        queue = [_filled(left, all_, task.generator) for left, all_ in zip(queue, learn, strict=True)]
        batch = [_picked(data, indices[:BATCH]) for data, indices in zip(task.data, queue, strict=True)]
        queue = [indices[BATCH:] for indices in queue]
        goal = _goal(task, choice, batch)
        _, by_q, by_r = goal.by_noise(choice)
        task.charge(price * sum(len(runs.seeds) for runs in batch))
        slope = -factors.slopes(point, by_q, np.zeros_like(by_r) if held_r else by_r) / goal.steps
        norm = float(np.linalg.norm(slope))
        if not np.isfinite(norm):
            return
        slope *= min(1.0, CLIP / max(norm, 1e-300))
        mean, square = MEAN * mean + (1 - MEAN) * slope, SQUARE * square + (1 - SQUARE) * slope**2
        corrected = mean / (1 - MEAN ** (step + 1)), square / (1 - SQUARE ** (step + 1))
        rate = RATE * 0.5 ** (step // HALVED_EVERY)
        point = point - rate * corrected[0] / (np.sqrt(corrected[1]) + TINY)


class Factors:
    """Q and R as functions of the entries of their Cholesky factors, with logarithms on the diagonals."""

    def __init__(self, q: np.ndarray, r: np.ndarray):
        """Begin at some Q and R."""
        self._sizes = len(q), len(r)
        self.first = np.concatenate(
            [_entries(np.linalg.cholesky(cov + RIDGE * np.eye(len(cov)))) for cov in (q, r)]
        )

    def matrices(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Q and R."""
        q, r = (factor @ factor.T for factor in self._factors(point))
        return q, r

    def slopes(self, point: np.ndarray, by_q: np.ndarray, by_r: np.ndarray) -> np.ndarray:
        """Derivatives by the entries from those by the matrices: dJ = tr(G dQ), so dJ/dL = 2 G L."""
        parts = []
        for factor, by in zip(self._factors(point), (by_q, by_r), strict=True):
            by_factor = 2.0 * by @ factor
            np.fill_diagonal(by_factor, np.diag(by_factor) * np.diag(factor))
            parts.append(by_factor[np.tril_indices(len(factor))])
        return np.concatenate(parts)

    def _factors(self, point: np.ndarray) -> list[np.ndarray]:
        factors, first = [], 0
        for size in self._sizes:
            factor, count = np.zeros((size, size)), size * (size + 1) // 2
            factor[np.tril_indices(size)] = point[first : first + count]
            np.fill_diagonal(factor, np.exp(np.diag(factor)))
            factors.append(factor)
            first += count
        return factors


def _entries(factor: np.ndarray) -> np.ndarray:
    entries = factor.copy()
    np.fill_diagonal(entries, np.log(np.diag(factor)))
    return entries[np.tril_indices(len(factor))]


def _goal(task: Task, choice: Choice, data: Sequence[Data]) -> Objective:
    return objective_of(choice, task.problems, data, task.free, MSE)


def _filled(indices: np.ndarray, all_: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    return indices if len(indices) else generator.permutation(all_)


def _picked(data: Data, indices: np.ndarray) -> Data:
    """Some runs of data."""

    def of(array: np.ndarray | None) -> np.ndarray | None:
        return None if array is None else array[indices]

    pick: Callable = of
    return data._replace(
        seeds=tuple(data.seeds[i] for i in indices.tolist()),
        inputs=pick(data.inputs),
        measurements=pick(data.measurements),
        filter_keys=pick(data.filter_keys),
        states=pick(data.states),
        outputs=None,
        counted=pick(data.counted),
    )
