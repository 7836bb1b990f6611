"""The posterior of a model's numbers by the no-U-turn sampler, along the exact gradient of the likelihood."""

from __future__ import annotations

import warnings
from contextlib import suppress

import numpy as np

from tuning.likelihood.gradient import DIVERGED
from tuning.search.objectives import LIKELIHOOD
from tuning.ways.posterior import DEVIATION
from tuning.ways.task import Spent, Task

WARM_UP, DRAWS = 300, 500
EDGE = 1e-3  # part of a range that a start keeps from its ends
LEAST = 1e-300  # below which s (1 - s) has no logarithm


def nuts(task: Task) -> None:
    """The mean of p(theta | z) in coordinates, with normal priors about the start, by Hamiltonian dynamics.

        theta = low + (high - low) s(y),   s(y) = 1 / (1 + exp(-y))
        log p(y | z) = log p(z | theta) - |theta - theta_0|^2 / (2 d^2) + sum log s(y) (1 - s(y)),   d = log 10

    It is the posterior of the way `posterior`, from fewer draws, each of which takes several gradients. Draws of
    the warm-up count until others are there. The sampler is nutpie's.

    Source: Hoffman, Gelman (2014), "The No-U-Turn Sampler", J. Machine Learning Research 15.
    """
    with task.uncounted(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the packages that it imports
        import nutpie
        from nutpie.compiled_pyfunc import from_pyfunc

    goal = task.goal(LIKELIHOOD, keeps=False)
    low, high = goal.coordinates.low, goal.coordinates.high
    centre = np.clip(goal.coordinates.of(goal.untuned), low, high)
    p, draws = len(centre), list[np.ndarray]()

    def point_at(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s = 0.5 * (1.0 + np.tanh(0.5 * y))
        return low + (high - low) * s, s

    def density(y: np.ndarray) -> tuple[float, np.ndarray]:
        point, s = point_at(y)
        try:
            task.check()
            found, away = goal(point), (point - centre) / DEVIATION**2
        except Spent:  # an exception would end the process: the other draws are of something cheap, and not kept
            return -0.5 * float(y @ y), -y
        except ValueError:  # the filter diverges
            return -DIVERGED, np.zeros(p)
        value = found.values.sum() - 0.5 * (point - centre) @ away + np.log(np.maximum(s * (1.0 - s), LEAST)).sum()
        by_point = found.gradients.sum(axis=0) - away
        slope = by_point * (high - low) * s * (1.0 - s) + 1.0 - 2.0 * s
        if not (np.isfinite(value) and np.isfinite(slope).all()):
            return -DIVERGED, np.zeros(p)
        return float(value), slope

    def keep(y: np.ndarray) -> dict[str, np.ndarray]:
        draws.append(point_at(y)[0])
        counted = draws[WARM_UP:] or draws[len(draws) // 2 :]
        with suppress(Spent):
            task.keep(goal.choice_at(np.mean(counted, axis=0)))
        return {"y": y}

    inside = np.clip((centre - low) / (high - low), EDGE, 1.0 - EDGE)
    first = np.log(inside / (1.0 - inside))  # nutpie itself would begin within factors of a thousand about it
    form = [np.dtype(np.float64)], [(p,)], ["y"]
    model = from_pyfunc(p, lambda: density, lambda *_: keep, *form, make_initial_point_fn=lambda seed: first)
    settings = {"draws": DRAWS, "tune": WARM_UP, "chains": 1, "seed": task.seed, "progress_bar": False}
    nutpie.sample(model, return_raw_trace=True, **settings)
