"""Adaptive filters run until they have converged: their mean Q and R, kept constant from then on."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from filters import make_filter
from tuning.evaluation.baselines import with_covariances
from tuning.ways.task import Task

FORGETTING = 0.995  # of Q and R a step


def converged(name: str, numbers: dict[str, float]) -> Callable[[Task], None]:
    """The way that runs an adaptive filter over each training run in turn, beginning with what the last one found.

    What a run finds is the mean over its second half of the filter's R, and of its Q where it learns that. In the
    end it is the mean over the second half of the runs.
    """

    def follow(task: Task) -> None:
        model = task.model(task.start)
        q, r = model.process_noise_cov, model.measurement_noise_cov
        found: list[tuple[np.ndarray, np.ndarray]] = []
        for place, (_, data) in enumerate(zip(task.problems, task.data, strict=True)):
            for index in range(len(data.seeds)):
                try:
                    model = task.model(task.start, place).replace(process_noise_cov=q, measurement_noise_cov=r)
                    q, r = _means(make_filter(name, model, **numbers), data.one(index))
                except ValueError:  # a belief that is none
                    raise ValueError(
                        f"way {name!r} failed: its Q or R is no covariance after {len(found)} runs"
                    ) from None
                task.charge(1)
                found.append((q, r))
                half = found[len(found) // 2 :]
                means = (np.mean([one[side] for one in half], axis=0) for side in (0, 1))
                task.keep(with_covariances(task.start, *_diagonals(task, *means)))

    return follow


def _means(filter_, data) -> tuple[np.ndarray, np.ndarray]:
    """Mean Q (n, n) and R (m, m) over the second half of a run."""
    belief, qs, rs = filter_.init(), [], []
    for k in range(data.measurements.shape[1]):
        if k:
            belief = filter_.predict(belief, data.inputs[0, k - 1])
        belief, _ = filter_.update(belief, data.measurements[0, k])
        if 2 * k >= data.measurements.shape[1]:
            rs.append(filter_.estimated_noise(belief))
            learns = hasattr(filter_, "estimated_process_noise")
            qs.append(filter_.estimated_process_noise(belief) if learns else filter_.model.process_noise_cov)
    return np.mean(qs, axis=0), np.mean(rs, axis=0)


def _diagonals(task: Task, q: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Q and R without correlations, unless these are tuned."""
    q = q if task.options.get("full_q") or not task.start.model else np.diag(np.diag(q))
    if task.options.get("hold_r"):
        return q, None
    return q, r if task.options.get("full_r") else np.diag(np.diag(r))


sage_husa = converged("sage-husa", {"forgetting_factor": FORGETTING, "process_forgetting_factor": FORGETTING})
vb = converged("vb", {"forgetting_factor": FORGETTING})
