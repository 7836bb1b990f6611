"""What residuals of the true states say of a model: noise that is white about zero has no mean and no memory."""

from __future__ import annotations

import numpy as np

from thruster_env.plants.quantities import Quantity
from tuning.evaluation.residuals import noise_estimation
from tuning.problems.problem import Problem

SMALL = 0.1  # of a mean over its deviation, or of a correlation: what is below says little of a model


def residual_sentences(problem: Problem, seed: int = 0) -> list[str]:
    """What noise estimation tells beside its Q and R, in a sentence; none where there is no truth.

    Of the process noise w = x' - f(x, u) and the measurement noise v = z - h(x) of the training runs it gives the
    mean over the deviation and the correlation with the next step, where one of these is above 0.1.
    """
    found = noise_estimation(problem, seed)
    if found.process_cov is None or found.measurement_cov is None:
        return []
    model = problem.quantities
    w = _told(model.states, found.process_cov, found.process_mean, found.process_correlation)
    v = _told(model.measurements, found.measurement_cov, found.measurement_mean, found.measurement_correlation)
    parts = [f"{what} {', '.join(some)}" for what, some in (("w of", w), ("v of", v)) if some]
    if not parts:
        return [
            "Residuals of the true states, w = x' - f(x, u) and v = z - h(x), have neither a mean nor a memory "
            f"above {SMALL:g}: nothing speaks against the model."
        ]
    return [
        f"Residuals of the true states, w = x' - f(x, u) and v = z - h(x), are no white noise about zero: "
        f"{'; '.join(parts)} (mean over deviation; correlation with the next step). No Q or R can stand for that: "
        "the model is wrong there."
    ]


def _told(
    quantities: tuple[Quantity, ...], cov: np.ndarray, mean: np.ndarray | None, correlation: np.ndarray | None
) -> list[str]:
    deviations = np.sqrt(np.diag(cov))
    if mean is None or correlation is None or not deviations.any():
        return []
    relative = np.divide(mean, deviations, out=np.zeros_like(mean), where=deviations > 0)
    rows = zip(quantities, relative.tolist(), correlation.tolist(), strict=True)
    return [f"{one.symbol} ({a:+.2g}; {b:+.2g})" for one, a, b in rows if max(abs(a), abs(b)) > SMALL]
