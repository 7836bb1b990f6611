"""The log-likelihood of innovations, its gradient and its information along parameters of a whole model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from filters.innovation_slopes import noted, statistics_of
from filters.likelihood import check_shapes
from filters.recursion import recursion_of
from filters.sensitivity_parts import parts_of
from numerics.angles import kept
from numerics.compiled import CompiledOrPython, function_fingerprint, is_interpreting
from numerics.sources import Source
from numerics.threads import spread
from plants.layout import number_places
from plants.shape import Functions, Shape, observation_slopes, transition_slopes
from plants.state_space import StateSpaceModel


class ModelSlopes(NamedTuple):
    """Derivatives of a model with respect to p parameters, each scaled so that 1 is a sensible change of it."""

    constants: np.ndarray  # (p, c)
    process_noise_cov: np.ndarray  # (p, n, n), symmetric
    measurement_noise_cov: np.ndarray  # (p, m, m), symmetric
    prior_mean: np.ndarray  # (p, n)
    prior_cov: np.ndarray  # (p, n, n), symmetric


class Sensitivity(NamedTuple):
    """Log-likelihood of the innovations of B trajectories, its slopes along p parameters and their information."""

    values: np.ndarray  # (B,)
    gradients: np.ndarray  # (B, p)
    information: np.ndarray  # (B, p, p), Fisher's, as if the innovations had the covariances S
    block_gradients: np.ndarray  # (B, blocks, p), of the parts of each trajectory


def sensitivity(
    model: StateSpaceModel,
    inputs: np.ndarray,
    measurements: np.ndarray,
    slopes: ModelSlopes,
    *,
    degrees: float = math.inf,
    blocks: int = 1,
    predicted: Sequence[bool] | None = None,
) -> Sensitivity:
    """`likelihood`, and Fisher's information, for parameters that move all numbers of a model.

    Along a parameter the constants move by dc, and with them f, h and their Jacobians: by central differences of
    the model, whose steps are relative to |c| + |dc|. So a unit of a parameter should be a sensible amount of it,
    as a hundredth of its range or the unit of its logarithm.

    Args:
        model: the model at which slopes are taken.
        inputs: (B, K, p).
        measurements: (B, K + 1, m); NaN where missing.
        slopes: how the model changes along each parameter.
        degrees: degrees of freedom of a Student-t density with the covariance S in place of the normal one, which
            outliers move less; above 2. The filter stays as it is.
        blocks: number of equal parts of each trajectory, whose gradients are returned separately.
        predicted: (m,) which channels the filter only predicts, after it has seen the others, and is never updated
            with: such as a load cell that is there for the identification only. Their prediction errors enter as
            innovations do. As nothing corrects them, they are correlated in time, and the information is
            overestimated.

    Raises:
        ValueError: if shapes do not fit, or degrees are not above 2.

    Source: Gupta, Mehra (1974), as `likelihood`; Astrom (1980), "Maximum likelihood and prediction error methods",
    Automatica 16(5), for the information.
    """
    if not degrees > 2:
        raise ValueError(f"degrees of freedom must be above 2, but got {degrees!r}")
    inputs, measurements = (np.ascontiguousarray(a, dtype=np.float64) for a in (inputs, measurements))
    slopes = ModelSlopes(*(np.ascontiguousarray(slope, dtype=np.float64) for slope in slopes))
    n, m, p, count = model.n, model.m, len(slopes.constants), len(measurements)
    given = {"inputs": inputs, "measurements": measurements, **slopes._asdict()}
    check_shapes(given, model, (p, len(model.constants)), (p, n, n), (p, m, m), (p, n), (p, n, n))
    prior = np.concatenate([slopes.prior_mean, slopes.prior_cov.reshape(p, n * n)], axis=1)
    out, information = np.zeros((count, blocks, 1 + p)), np.zeros((count, p, p))
    noise = slopes.process_noise_cov.reshape(p, n * n), slopes.measurement_noise_cov.reshape(p, m * m)
    moves = *noise, slopes.constants, _relative(slopes.constants, model), prior
    fed = 1.0 - np.array(np.zeros(m) if predicted is None else predicted, dtype=np.float64)
    if fed.shape != (m,):
        raise ValueError(f"predicted must say of each of {m} channels whether it is, but got {predicted!r}")
    accumulate = _build(model.functions, model.shape, is_interpreting())
    arguments = inputs, measurements, model.numbers, *moves, float(degrees), fed, out, information
    spread(lambda first, last: accumulate(*arguments, first, last), count)
    total = out.sum(axis=1)
    return Sensitivity(total[:, 0], total[:, 1:], information, out[:, :, 1:])


def _relative(slopes: np.ndarray, model: StateSpaceModel) -> np.ndarray:
    """The largest of |dc|/(|c| + |dc|) for each parameter, (p,), in which steps along it are measured."""
    base = np.abs(np.array(model.constants, dtype=np.float64)) + np.abs(slopes)
    return (np.abs(slopes) / np.where(base > 0, base, 1.0)).max(axis=1, initial=0.0)


@cache
def _build(functions: Functions, shape: Shape, interpreting: bool):
    n, m, width = shape.n, shape.m, noted(shape.m)
    transition, observe = kept(functions.transition, "x, u, c", shape.state_angles), functions.observe
    transition_matrix = transition_slopes(functions, shape)
    observation_matrix = observation_slopes(functions, shape)
    substeps = number_places(n, m).substeps
    (
        constants,
        scales,
        control,
        reading,
        prior_mean,
        prior_cov,
        q,
        r,
        q_slope,
        r_slope,
        mean_slope,
        cov_slope,
        store_mean_slope,
        store_cov_slope,
        difference,
        root_of,
        divide,
        present_rows,
        present,
        moved,
        moved_slope,
        grown,
        seen,
        seen_slope,
        correlation,
        uneven_gain,
        corrected,
        corrected_slope,
        reduced,
        reduced_slope,
    ) = recursion_of(shape)
    constants_slope, motion, motion_slope, observation, observation_slope = parts_of(functions, shape)
    weigh, log_likelihood, likelihood_slope, note, sum_up = statistics_of(m)
    source = Source("chosen", "z, fed, turn", result=(m,), z=(m,), fed=(m,))
    chosen = source.function(source.vector(m, lambda i: f"z[{i}] if fed[{i}] == turn else nan"), nan=math.nan)
    fingerprint = function_fingerprint(transition, transition_matrix, observe, observation_matrix, within=__name__)

    def accumulate(
        all_inputs,
        measurements,
        numbers,
        q_slopes,
        r_slopes,
        constants_slopes,
        sizes,
        prior_slopes,
        degrees,
        fed,
        out,
        information,
        first,
        last,
    ):
        fingerprint  # noqa: B018 - part of the cache's key
        c, s = constants(numbers), scales(numbers)
        rows, notes = np.zeros((q_slopes.shape[0], n + n * n)), np.zeros((q_slopes.shape[0], width))
        turns = 1 if fed.min() > 0.0 else 2  # of a sample: what the filter sees, then what it only predicts
        for b in range(first, last):
            x, p = prior_mean(numbers), prior_cov(numbers)
            rows[:] = prior_slopes
            for k in range(measurements.shape[1]):
                if k > 0:
                    u = control(all_inputs[b, k - 1])
                    for _ in range(int(numbers[substeps])):
                        f = transition_matrix(x, s, u, c)
                        for j in range(rows.shape[0]):
                            dx, dp = mean_slope(rows[j]), cov_slope(rows[j])
                            dc, size = constants_slope(constants_slopes[j]), sizes[j]
                            df = motion_slope(x, s, u, c, dx, dc, size)
                            store_mean_slope(rows[j], motion(f, dx, x, u, c, dc, size))
                            store_cov_slope(rows[j], moved_slope(f, df, p, dp))
                        x, p = transition(x, u, c), moved(f, p)
                    p = grown(p, q(numbers))
                    for j in range(rows.shape[0]):
                        store_cov_slope(rows[j], grown(cov_slope(rows[j]), q_slope(q_slopes[j])))
                part, sample = k * out.shape[1] // measurements.shape[1], reading(measurements[b, k])
                for turn in range(turns):
                    z, freedom = chosen(sample, fed, 1.0 - turn), degrees if turn == turns - 1 else math.inf
                    h = present_rows(observation_matrix(x, s, c), z)
                    v, spread_of_v = difference(z, observe(x, c)), present(r(numbers), z)
                    if turn == 0:
                        spread_of_v = seen(h, p, spread_of_v)
                    root = root_of(spread_of_v)
                    gain = divide(correlation(p, h), root)
                    w = weigh(v, root)
                    out[b, part, 0] += log_likelihood(v, root, z, w, freedom)
                    for j in range(rows.shape[0]):
                        dx, dp = mean_slope(rows[j]), cov_slope(rows[j])
                        dc, size = constants_slope(constants_slopes[j]), sizes[j]
                        dh = present_rows(observation_slope(x, s, c, dx, dc, size), z)
                        dy = observation(h, dx, x, c, dc, size, z)  # less the slope of the innovation
                        ds = present(r_slope(r_slopes[j]), z)
                        if turn == 0:
                            ds = seen_slope(h, dh, p, dp, ds)
                        out[b, part, 1 + j] += likelihood_slope(v, dy, root, ds, z, w, freedom)
                        note(notes[j], dy, ds, root, z)
                        if turn == 0:
                            dgain = divide(uneven_gain(h, dh, p, dp, gain, ds), root)
                            store_mean_slope(rows[j], corrected_slope(dx, gain, dgain, v, dy))
                            store_cov_slope(rows[j], reduced_slope(dp, gain, dgain, spread_of_v, ds))
                    sum_up(notes, information[b])
                    if turn == 0:
                        x, p = corrected(x, gain, v), reduced(p, gain, spread_of_v)

    return CompiledOrPython(accumulate)
