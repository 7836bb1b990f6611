"""A filter over many trajectories in one compiled call that uses all cores."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from filters.engine.compile import batch, new_memory, vectors
from filters.estimators.foreign import ForeignFilter
from filters.filter import Filter
from thruster_env.core.checks import as_floats, covariance, short_repr
from thruster_env.core.streams import filter_keys
from thruster_env.core.threads import spread
from thruster_env.model.layout import LANES, with_root


class Estimates(NamedTuple):
    """A filter's output over a batch of B trajectories of K steps; index 0 is after the first measurement.

    Attributes:
        means: of the states, (B, K + 1, n), in the units of the model.
        covs: covariances of the errors, (B, K + 1, n, n).
        innovations: measurements minus their predictions, (B, K + 1, m); zero in missing channels.
        innovation_covs: S, (B, K + 1, m, m).
        log_likelihoods: of the innovations, (B, K + 1).
        divergences: restarts from the prior after an estimate that was not finite, (B,).
    """

    means: np.ndarray
    covs: np.ndarray
    innovations: np.ndarray
    innovation_covs: np.ndarray
    log_likelihoods: np.ndarray
    divergences: np.ndarray


def estimates_of(rows: Sequence[tuple], divergences: int) -> Estimates:
    """What `run` gives of one trajectory, from what `Session.told` said of each row."""
    parts = [np.array(part)[None] for part in zip(*rows, strict=True)]
    return Estimates._make([*parts, np.array([divergences])])


def run(
    filter_: Filter,
    keys: np.ndarray | None = None,
    inputs: np.ndarray | None = None,
    measurements: np.ndarray | None = None,
    *,
    process_noise_covs: np.ndarray | None = None,
    measurement_noise_covs: np.ndarray | None = None,
) -> Estimates:
    """Filter many trajectories in one compiled call that uses all cores.

    Args:
        filter_: any filter, or an estimator of another package in its place.
        keys: random keys, one a trajectory, (B, 2): two whole numbers below 2^32 each; those of seeds 0, 1, ...,
            B - 1 if None. Filters that draw nothing ignore them: run(filter_, inputs=u, measurements=z).
        inputs: u, (B, K, p), in the units of the model's inputs; None for a model without inputs. The filter
            predicts step k + 1 with u[:, k].
        measurements: z, (B, K + 1, m), in the units of the model's measurements, NaN where missing; z[:, 0]
            updates the prior, and z[:, k + 1] the prediction with u[:, k].
        process_noise_covs: Q of every step, (K, n, n), in place of the model's. Covariances are per step and do
            not scale with dt.
        measurement_noise_covs: R of every measurement, (K + 1, m, m), in place of the model's.

    Returns:
        `Estimates`, which do not depend on the number of cores.

    Raises:
        ValueError: if shapes do not fit or an input is not finite; errors of `ForeignFilter.fill` for estimators.
    """
    keys, inputs, z = trajectories(filter_, keys, inputs, measurements)
    n, (count, times, m) = filter_.kernel_model.n, z.shape
    out = Estimates(
        np.empty((count, times, n)),
        np.empty((count, times, n, n)),
        np.empty((count, times, m)),
        np.empty((count, times, m, m)),
        np.empty((count, times)),
        np.empty(count),
    )
    noise = noise_rows(filter_, times, process_noise_covs, measurement_noise_covs)
    if isinstance(filter_, ForeignFilter):
        filter_.fill(keys, inputs, z, tuple(out))
        return out
    run_all = _run_side_by_side if filter_.kernels().vectors else _run_one_by_one
    run_all(filter_, (keys, inputs, z), noise, out)
    return out


def _run_one_by_one(filter_: Filter, data: tuple, noise: tuple, out: Estimates) -> None:
    kernels, numbers, size = filter_.kernels(), filter_.numbers, filter_.size
    run_part = batch(kernels)

    def part(first: int, last: int) -> None:
        memory = new_memory(kernels, size)  # serves the part's trajectories one after the other
        run_part(*memory, size, *data, numbers.copy(), noise, tuple(out), first, last)

    spread(part, len(out.means))


def _run_side_by_side(filter_: Filter, data: tuple, noise: tuple, out: Estimates) -> None:
    count, numbers, run_part = len(out.means), filter_.numbers, vectors(filter_.kernels())

    def part(first: int, last: int) -> None:
        run_part(*data, numbers, noise, tuple(out), first * LANES, min(last * LANES, count))

    spread(part, -(-count // LANES))


def trajectories(
    filter_: Filter, keys: np.ndarray | None, inputs: np.ndarray | None, measurements: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The arguments of `run` as the arrays that compiled code takes; ValueError if something is wrong."""
    model = filter_.kernel_model
    # Arrays that may be written to: others are another type to numba, which compiles once more for them.
    requirements: tuple[Literal["C_CONTIGUOUS", "WRITEABLE"], ...] = "C_CONTIGUOUS", "WRITEABLE"
    if measurements is None:
        raise ValueError("measurements must be an array (B, K + 1, m), but got None")
    if inputs is None or keys is None:
        shape = np.shape(measurements)
        count, steps = shape[:2] if len(shape) == 3 else (0, 1)
        inputs = np.zeros((count, steps - 1, 0)) if inputs is None else inputs
        keys = filter_keys(range(count)).reshape(count, 2) if keys is None else keys
    given = {"keys": keys, "inputs": inputs, "measurements": measurements}
    keys, inputs, z = (np.require(_floats(name, value), np.float64, requirements) for name, value in given.items())
    if z.ndim != 3 or inputs.ndim != 3 or keys.shape != (len(z), 2):
        raise ValueError(
            "keys, inputs, measurements must have shapes (B, 2), (B, K, p), (B, K + 1, m), "
            f"but got {keys.shape}, {inputs.shape}, {z.shape}"
        )
    count, times, m = z.shape
    if inputs.shape != (count, times - 1, model.inputs) or m != model.m:
        raise ValueError(
            f"inputs and measurements must have shapes {(count, times - 1, model.inputs)} and "
            f"{(count, times, model.m)}, but got {inputs.shape} and {z.shape}"
        )
    if not np.isfinite(inputs).all() or np.isinf(z).any():
        raise ValueError("inputs must be finite, and measurements finite or NaN, but some are not")
    if not ((keys >= 0) & (keys < 2**32) & (keys == np.floor(keys))).all():
        raise ValueError("keys must be whole numbers from 0 to 2^32 - 1, but some are not")
    return keys, inputs, z


def _floats(name: str, value) -> np.ndarray:
    try:
        return as_floats(value)
    except ValueError:
        raise ValueError(f"{name} must be an array of numbers, but got {short_repr(value)}") from None


def noise_rows(
    filter_: Filter, times: int, process_noise_covs, measurement_noise_covs
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (Q, its root) of each step and (R, its root) of each measurement; no rows where the model's act.

    Raises ValueError for what is no covariance, other shapes, and what the filter cannot take.
    """
    filter_.check_noise(process_noise_covs, measurement_noise_covs)
    model = filter_.kernel_model
    return (
        _noise_rows("process_noise_covs", process_noise_covs, times - 1, model.n),
        _noise_rows("measurement_noise_covs", measurement_noise_covs, times, model.m),
    )


def _noise_rows(name: str, given, count: int, size: int) -> np.ndarray:
    if given is None:
        return np.empty((0, 2 * size * size))
    given = _floats(name, given)
    if given.shape != (count, size, size):
        raise ValueError(f"{name} must have shape {(count, size, size)}, but got {given.shape}")
    definite = name.startswith("measurement")
    return np.array([with_root(covariance(name, cov, size, positive_definite=definite)) for cov in given])
