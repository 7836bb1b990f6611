"""Q and R of a column beside statsmodels and pykalman, for docs/q_and_r.md: `python -m benchmarks.columns`.

Sets of 500 numbers are drawn from a level and from a constant velocity. Each package finds Q and R on the first
half; what counts is the log-likelihood of the second half, filtered with these from the beginning, and the time.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable

import numpy as np

import filters
import tuning
from filters.models import named_model
from thruster_env.core.text_tables import markdown_table

SETS, ROWS = 20, 500
TRUTH = {"constant": "drift", "constant-velocity": "acceleration"}  # the number of each model
WIDE = 1e6
Found = Callable[[str, np.ndarray], filters.KalmanFilter]  # of a model's name and numbers


def drawn(name: str, seed: int) -> tuple[np.ndarray, filters.KalmanFilter]:
    """Numbers of a model with R = 1 and a density of its noise of 0.01 to 100, and the filter that knows both."""
    generator = np.random.default_rng([seed, len(name)])
    model = named_model(name).model({TRUTH[name]: 10.0 ** generator.uniform(-2.0, 2.0)}, 1.0, 1.0)
    filter_ = filters.KalmanFilter(model=model)
    f, _, _, h, _ = filter_.model.matrices()
    values, axes = np.linalg.eigh(filter_.model.process_noise_cov)
    root, x, z = axes * np.sqrt(np.maximum(values, 0.0)), np.zeros(len(f)), np.empty(ROWS)
    for k in range(ROWS):
        z[k] = h[0] @ x + generator.normal()
        x = f @ x + root @ generator.normal(size=len(f))
    return z, filter_


def ours(name: str, z: np.ndarray) -> filters.KalmanFilter:
    """`tuning.fit`."""
    return tuning.fit(z, model=name).filter


def by_statsmodels(name: str, z: np.ndarray) -> filters.KalmanFilter:
    """`UnobservedComponents`, whose local linear trend has a constant velocity's states and a diagonal Q."""
    from statsmodels.tsa.statespace.structural import UnobservedComponents

    return filters.from_statsmodels(
        UnobservedComponents(z, "llevel" if name == "constant" else "lltrend").fit(disp=0)
    )


def by_pykalman(name: str, z: np.ndarray) -> filters.KalmanFilter:
    """Expectation maximisation of Q and R, whole matrices, with the default of ten iterations."""
    import pykalman

    signal = named_model(name).signal({TRUTH[name]: 1.0})
    n = len(signal.output)
    kf = pykalman.KalmanFilter(
        transition_matrices=signal.transition(1.0),
        observation_matrices=signal.output[None],
        initial_state_mean=z[0] * signal.output,
        initial_state_covariance=WIDE * np.eye(n),
        em_vars=["transition_covariance", "observation_covariance"],
    )
    return filters.from_pykalman(kf.em(z))


PACKAGES: dict[str, Found] = {"tuning.fit": ours, "statsmodels": by_statsmodels, "pykalman's EM": by_pykalman}


def held_out(filter_: filters.KalmanFilter, z: np.ndarray) -> float:
    """Log-likelihood of the second half."""
    return float(filters.run(filter_, z).log_likelihoods[ROWS // 2 :].sum())


def main() -> None:
    """Print the table: means over sets of the loss to the filter that knows Q and R, with standard errors."""
    rows = []
    for name in TRUTH:
        losses: dict[str, list[float]] = {package: [] for package in PACKAGES}
        seconds: dict[str, list[float]] = {package: [] for package in PACKAGES}
        for seed in range(SETS):
            z, knowing = drawn(name, seed)
            for package, find in PACKAGES.items():
                begin = time.process_time()
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    filter_ = find(name, z[: ROWS // 2])
                seconds[package].append(time.process_time() - begin)
                losses[package].append(held_out(knowing, z) - held_out(filter_, z))
        for package in PACKAGES:
            loss = np.array(losses[package])
            mean = f"{loss.mean():.2f} ± {loss.std(ddof=1) / np.sqrt(SETS):.2f}"
            rows.append((name, package, mean, f"{loss.max():.1f}", f"{np.median(seconds[package]):.2f}"))
    print(markdown_table(("data of", "found by", "mean loss", "largest", "seconds"), rows))


if __name__ == "__main__":
    main()
