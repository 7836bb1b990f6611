"""The stochastic and the deterministic ensemble Kalman filter, localisation, and random rotations."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, ClassVar

import numpy as np

from filters.algebra.matrices import input_matrix
from filters.algebra.members import centred, mean
from filters.algebra.operations import divide, mask_missing, present, uncorrelated, wrap
from filters.algebra.points import root
from filters.algebra.roots import forward_quotient
from filters.engine.belief import Kernels, filter_offset, memory_offsets
from filters.ensembles.ensemble import EnsembleFilter, add_process_noise, compare, expect, propagate
from filters.pages.kernels import MembersMemory, Stage, extras_size, members_kernels, stored
from filters.pages.kernels import member_works_of as works_of
from filters.pages.page import Page
from thruster_env.core.checks import positive, switch
from thruster_env.core.streams import FILTER_ROTATION, fill_normals
from thruster_env.graphs.programs import Place
from thruster_env.model.shape import Functions, Shape

SUPPORT = (10.0 / 3.0) ** 0.5  # half the range of a taper, over its radius


def gaspari_cohn(distance: np.ndarray, radius: float) -> np.ndarray:
    """A taper of distances: nearly exp(-(distance/radius)^2/2), by up to 0.034 more, and 0 from 3.66 radii on.

    With r = distance/(radius (10/3)^1/2) it is 1 - 5/3 r^2 + 5/8 r^3 + r^4/2 - r^5/4 up to r = 1 and r^5/12 -
    r^4/2 + 5/8 r^3 + 5/3 r^2 - 5 r + 4 - 2/(3 r) up to 2: a correlation in up to three dimensions.

    Source: Gaspari, Cohn (1999), "Construction of correlation functions in two and three dimensions", (4.10).
    """
    r = np.asarray(distance) / (radius * SUPPORT)
    near = 1.0 + r**2 * (-5.0 / 3.0 + r * (5.0 / 8.0 + r * (0.5 - 0.25 * r)))
    s = np.maximum(r, 1.0)
    far = 4.0 - 2.0 / (3.0 * s) + s * (-5.0 + s * (5.0 / 3.0 + s * (5.0 / 8.0 + s * (-0.5 + s / 12.0))))
    return np.where(r < 1.0, near, np.where(r < 2.0, far, 0.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalisedFilter(EnsembleFilter):
    """Base of the ensemble filters that may be localised.

    Attributes:
        radius: of the taper by Gaspari and Cohn, in the unit of the model's `positions`; 0 for no localisation.
    """

    radius: float = 0.0

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "radius", positive("radius", self.radius, zero_allowed=True))
        if self.radius and self.model.positions is None:
            raise ValueError(f"radius must be 0 for a model without positions, but got {self.radius:g}")

    @property
    def tapers(self) -> Mapping[str, Any]:
        """Tapers between states and channels, (n, m), and between channels, (m, m); none without a radius."""
        positions = self.model.positions
        if not self.radius or positions is None:
            return {}
        (states, measured, _), distances = positions, positions.distances
        return {
            "taper": gaspari_cohn(distances(states, measured), self.radius),
            "between": gaspari_cohn(distances(measured, measured), self.radius),
        }

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Those of all ensembles, and tapers."""
        return {**super().parameters, **self.tapers}


def update_stochastic(model, x, z, e):
    """Update each member with the measurement z and its own noise; NaN marks missing channels."""
    d, C, v, S, _, level = compare(model, x, z)
    e = centred(e) if model.own.centred_perturbations else e
    return x + divide(C, S) @ (v - d - model.R_root @ e), v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class EnsembleKalmanFilter(LocalisedFilter):
    """Stochastic ensemble Kalman filter, on the full nonlinear model, with perturbed measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = h(x_j),  innovation = z - mean(y),  S = cov(y, y) + R,  K = cov(x, y) S^-1,
                 x_j += K (z - v_j - y_j),  v_j ~ N(0, R);  sample covariances with divisor N - 1

    The perturbations of an update depend on the key and the step only: two updates within one step use the same
    perturbations.

    Attributes:
        centred_perturbations: 1 for perturbations of the measurements whose sample mean is zero, 0 for independent
            ones. Centred, v_j is (N/(N - 1))^1/2 (v_j - mean(v)), whose covariance is R, and the mean moves as
            in the Kalman filter; the mean of independent ones, of covariance R/N, enters the estimate. Use it for
            small N.

        radius: of Gaspari and Cohn's taper, in the unit of the model's `Positions`; 0 for no localisation. With
            one, entries of cov(x, y) and cov(y, y) are multiplied by the taper of the distance of both
            (P-localisation).

    The other attributes are those of `EnsembleFilter`.

    Raises:
        ValueError: if a parameter is out of its range, or there is a radius for a model without positions.

    Source: Evensen (1994); Burgers, van Leeuwen, Evensen (1998), "Analysis scheme in the EnKF"; centred: Evensen
    (2004), "Sampling strategies and square root analysis schemes for the EnKF"; with tapers: Houtekamer, Mitchell
    (2001), "A sequential ensemble Kalman filter for atmospheric data assimilation".
    """

    name: ClassVar[str] = "enkf"
    page: ClassVar[Page] = Page(propagate, add_process_noise, update_stochastic)
    unrolled: ClassVar[tuple[str, ...]] = ("centred_perturbations",)
    centred_perturbations: int = 0

    def __post_init__(self):
        super().__post_init__()
        switch("centred_perturbations", self.centred_perturbations)


def reflect(table, rows, first, size, vector):
    """Reflect each of the first `rows` rows x in the plane normal to v: x -= 2 (x'v / v'v) v.

    v has the entries vector[first] ... vector[size - 1] at their places, and zeros before.
    """
    square = 0.0
    for j in range(first, size):
        square += vector[j] * vector[j]
    for i in range(rows):
        product = 0.0
        for j in range(first, size):
            product += table[i, j] * vector[j]
        factor = 2.0 * product / square
        for j in range(first, size):
            table[i, j] -= factor * vector[j]


@cache
def rotator(n: int, m: int) -> Callable:
    """Return `rotate(memory, size)`: X = X W for members X (n, N), W random and orthogonal with W 1 = 1.

    One reflection leads to a basis with the first axis (1, ..., 1)/N^1/2, and back. In this basis W is 1 on the
    first axis; on the other N - 1 it is a product of reflections in random directions, each in one dimension less
    than the
    one before, with a random sign at the end: uniform among all rotations and reflections.

    Source: Stewart (1980), "The efficient generation of random orthogonal matrices with an application to
    condition estimators"; for ensembles: Sakov, Oke (2008), "Implications of the form of the ensemble
    transformation in the ensemble square root filters".
    """
    layout = memory_offsets(n, m)
    step_offset, key_0, key_1 = layout.step, layout.key_0, layout.key_1

    def rotate(memory, size):
        row, table, draws = memory
        root = size**0.5
        # To the basis and back: v = (1, ..., 1)/N^1/2 - (1, 0, ..., 0).
        for turn in range(2):
            for j in range(size):
                draws[j] = 1.0 / root
            draws[0] -= 1.0
            reflect(table, n, 0, size, draws)
            if turn == 0:
                for first in range(1, size - 1):
                    # One counter for each vector of each step.
                    count = row[step_offset] * size + first
                    fill_normals(draws, size, count, FILTER_ROTATION, row[key_0], row[key_1])
                    norm = 0.0
                    for j in range(first, size):
                        norm += draws[j] * draws[j]
                    # The reflection in v + |v| e takes the random vector v to the first axis e.
                    draws[first] += norm**0.5 if draws[first] >= 0.0 else -(norm**0.5)
                    reflect(table, n, first, size, draws)
                fill_normals(draws, size, row[step_offset] * size, FILTER_ROTATION, row[key_0], row[key_1])
                for j in range(1, size):
                    if draws[j] < 0.0:
                        for i in range(n):
                            table[i, j] = -table[i, j]

    return rotate


@lru_cache(maxsize=64)
def with_rotation(kernels: Kernels) -> Kernels:
    """An ensemble's kernels with a random rotation after each update, which keeps mean and covariance."""
    rotate, update_plainly = rotator(kernels.n, kernels.m), kernels.update

    def update(memory, z, numbers, size):
        update_plainly(memory, z, numbers, size)
        rotate(memory, size)

    return kernels._replace(update=update)


def update_deterministic(model, x, z, e):
    """Update with the measurement z, with half the gain for deviations; NaN marks missing channels."""
    d, C, v, S, _, level = compare(model, x, z)
    return x + divide(C, S) @ (v - d * 0.5), v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class DeterministicUpdateFilter(EnsembleFilter):
    """Base of the ensemble filters whose update draws nothing.

    Attributes:
        rotations: 1 for a random rotation of the members about their mean after each update, 0 for none. It
            prevents outliers among the members if there is little or no process noise.
    """

    rotations: int = 0

    def __post_init__(self):
        super().__post_init__()
        switch("rotations", self.rotations)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        plain = super().kernels()
        return with_rotation(plain) if self.rotations else plain


@dataclass(frozen=True, kw_only=True, eq=False)
class DeterministicEnsembleKalmanFilter(LocalisedFilter, DeterministicUpdateFilter):
    """Deterministic ensemble Kalman filter: the gain updates the mean, half the gain the members' deviations.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = h(x_j),  innovation = z - mean(y),  S = cov(y, y) + R,  K = cov(x, y) S^-1,
                 mean += K innovation,  x_j - mean(x) -= K (y_j - mean(y))/2;  sample covariances, divisor N - 1

    With a linear h the covariance after the update is P - K H P + K H P H'K'/4, larger than the Kalman filter's P
    - K H P; the difference is small for inaccurate measurements. The update draws nothing: only the process noise
    of the members is random, and the error of its sample mean and covariance enters the estimate.

    Attributes:
        radius: of Gaspari and Cohn's taper, in the unit of the model's `Positions`; 0 for no localisation. With
            one, entries of cov(x, y) and cov(y, y) are multiplied by the taper of the distance of both
            (P-localisation).

    The other attributes are those of `DeterministicUpdateFilter`.

    Raises:
        ValueError: if a parameter is out of its range, or there is a radius for a model without positions.

    Source: Sakov, Oke (2008), "A deterministic formulation of the ensemble Kalman filter".
    """

    name: ClassVar[str] = "denkf"
    page: ClassVar[Page] = Page(propagate, add_process_noise, update_deterministic)


# Analyses in parts: each state with the channels near it, or one channel after the other.
#
# The page of such a filter propagates the members and predicts their measurements, but its update moves no
# member. The table has a row for each state, then one for each channel with independent noise of variance 1.


LEAST = 1e-3  # tapers below are set to zero


def row_moments(table, i, size):
    """Mean and sample variance of a row of the members."""
    mean, squares = 0.0, 0.0
    for j in range(size):
        mean += table[i, j] / size
    for j in range(size):
        squares += (table[i, j] - mean) ** 2
    return mean, squares / (size - 1)


def stretch_row(table, i, factor, size):
    """Multiply a row's deviations from its mean by a factor."""
    mean = 0.0
    for j in range(size):
        mean += table[i, j] / size
    for j in range(table.shape[1]):
        table[i, j] = mean + factor * (table[i, j] - mean)


def relax_row(table, i, before, part, size):
    """Restore a part of an update's reduction of a row's standard deviation; `before` is the variance before."""
    _, after = row_moments(table, i, size)
    if after > 0.0:
        stretch_row(table, i, 1.0 + part * ((before / after) ** 0.5 - 1.0), size)


def transform_state(table, i, n, v, z, taper, size):
    """Update state i by the transform filter, with R of each channel divided by its taper."""
    inner, along, near = np.zeros((size, size)), np.zeros(size), False
    for k in range(len(v)):
        if taper[k] > 0.0 and z[k] == z[k]:
            near = True
            for j in range(size):
                along[j] += taper[k] * table[n + k, j] * v[k]
                for other in range(size):
                    inner[j, other] += taper[k] * table[n + k, j] * table[n + k, other]
    mean, _ = row_moments(table, i, size)
    total = mean
    for j in range(size):
        inner[j, j] += size - 1.0
        total += inner[j, j]
    if not near:
        return
    if not abs(total) < np.inf:  # a belief that is lost
        table[i, :] = np.nan
        return
    values, vectors = np.linalg.eigh(inner)
    updated = np.full(size, mean)
    for axis in range(size):
        state, w = 0.0, 0.0
        for j in range(size):
            state += vectors[j, axis] * (table[i, j] - mean)
            w += vectors[j, axis] * along[j]
        for j in range(size):
            updated[j] += state * (w / values[axis] + ((size - 1.0) / values[axis]) ** 0.5 * vectors[j, axis])
    for j in range(size):
        table[i, j] = updated[j]


def gaussian_moves(y, v, tail, moves, size):
    """Moves of a channel's y (N,), with R = 1, for a measurement v, by the adjustment filter."""
    squares = 0.0
    for j in range(size):
        squares += y[j] ** 2
    gain, shrink = squares / (size - 1.0 + squares), ((size - 1.0) / (size - 1.0 + squares)) ** 0.5 - 1.0
    for j in range(size):
        moves[j] = gain * v + shrink * y[j]


def regress(table, n, y, moves, taper, size):
    """Move states by their regression on a channel's y, from the moves of y."""
    squares = 0.0
    for j in range(size):
        squares += y[j] ** 2
    for i in range(n):
        if taper[i] > 0.0 and squares > 0.0:
            mean, _ = row_moments(table, i, size)
            slope = 0.0
            for j in range(size):
                slope += (table[i, j] - mean) * y[j]
            for j in range(size):
                table[i, j] += slope * taper[i] / squares * moves[j]


def with_unit_noise(page: Page, memory: MembersMemory, model) -> dict[str, Stage]:
    """M^-1 (y - mean(y)) of members and M^-1 (z - mean(y)), with M M' = R: channels with independent noise."""
    measured, n, m = present(memory.z), memory.shape.n, memory.shape.m
    model.extras = memory.keep(page.started(model))  # the input that acts, if h takes it
    y, M = expect(model, memory.x, memory.z), root(uncorrelated(measured, model.R))
    v = mask_missing(measured, wrap(memory.z - mean(y), model.measurement_angles))
    rows = input_matrix(Place("table", n), (m,), member=True, like=memory.x)
    target = memory.read("rows", scratch_offset(page, memory.shape), m)
    return {"update": stored((forward_quotient(M, y - mean(y)), forward_quotient(M, v)), (rows, target))}


def scratch_offset(page: Page, shape: Shape) -> int:
    """The offset of scratch in a filter's row, after the extras of a page."""
    return memory_offsets(shape.n, shape.m).extras + extras_size(page, shape)


@lru_cache(maxsize=64)
def kernels_by_parts(page: Page, functions: Functions, shape: Shape, moves_of: Callable | None) -> Kernels:
    """Kernels of a page whose `model.own` has a taper (n, m) of states and channels, relaxation, and a tail.

    The update goes through the channels, whose y move by `moves_of(y, v, tail, moves, size)`; if that is None, it
    goes through the states.
    """
    plain, n, m = members_kernels(page, functions, shape), shape.n, shape.m
    look, rows, _ = works_of(page, functions, shape, with_unit_noise, n + m)["update"]
    tell, summarise, first = plain.update, plain.summarise, scratch_offset(page, shape)
    serial, move = moves_of is not None, gaussian_moves if moves_of is None else moves_of
    offsets = page.parameter_offsets(filter_offset(shape))
    taper, relaxation, tail = offsets["taper"], offsets["relaxation"], offsets["tail"]

    def update(memory, z, numbers, size):
        tell(memory, z, numbers, size)
        row, table, draws = memory
        tapers = numbers[taper : taper + n * m].reshape((n, m))
        v, moves, before = row[first : first + m], np.empty(size), np.empty(n)
        if numbers[relaxation] > 0.0:
            for i in range(n):
                _, before[i] = row_moments(table, i, size)
        look(row, z, numbers, table, draws, size)
        if serial:
            for k in range(m):
                if z[k] == z[k]:
                    if k > 0:
                        look(row, z, numbers, table, draws, size)
                    y = table[n + k, :size]
                    move(y, v[k], numbers[tail], moves, size)
                    regress(table, n, y, moves, tapers[:, k], size)
        else:
            for i in range(n):
                transform_state(table, i, n, v, z, tapers[i], size)
        if numbers[relaxation] > 0.0:
            for i in range(n):
                relax_row(table, i, before[i], numbers[relaxation], size)
        summarise(memory, size)

    return plain._replace(update=update, table_rows=max(plain.table_rows, rows), scratch=m)


def look(model, x, z, e):
    """An update that moves no member: it only returns innovation, S and likelihood."""
    _, _, v, S, _, level = compare(model, x, z)
    return x, v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalisedByParts(LocalisedFilter, DeterministicUpdateFilter):
    """Base of filters whose update goes through states or channels if there is a radius.

    Channels with correlated noise are first made independent, by the lower triangular root of R, and keep their
    positions. Such an update is neither in C nor on tensors.
    """

    moves_of: ClassVar[Callable | None] = None  # of one channel after the other, see `kernels_by_parts`

    @property
    def by_parts(self) -> bool:
        """Whether the update is by parts."""
        return bool(self.radius)

    @property
    def tapers(self) -> Mapping[str, Any]:
        """Tapers between states and channels, (n, m), and the normal quantile of 1/(N + 1); none without parts."""
        if not self.by_parts:
            return {}
        taper = super().tapers.get("taper", np.ones((self.model.n, self.model.m)))
        from statistics import NormalDist  # here, because it imports fractions and decimals

        tail = NormalDist().inv_cdf(1.0 / (self.ensemble_size + 1))
        return {"taper": np.where(taper > LEAST, taper, 0.0), "tail": tail}

    @property
    def plain_page(self) -> Page:
        """The page without inflation and relaxation; if the update is by parts, its update moves no member."""
        page = super().plain_page
        return page._replace(update=look) if self.by_parts else page

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        if not self.by_parts:
            return super().kernels()
        page, model = self.page_with(self.inflation != 1.0, relaxation=False), self.kernel_model
        kernels = kernels_by_parts(page, model.functions, model.shape, type(self).moves_of)
        return with_rotation(kernels) if self.rotations else kernels
