"""Mixtures of Gaussians: the Gaussian sum filter and the Takagi-Sugeno fuzzy filter."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import prod
from typing import Any, ClassVar, NamedTuple

import numpy as np

from filters.algebra.operations import choose, exceeds, present
from filters.algebra.points import dot, log_density, outer
from filters.algebra.tangents import added, innovation, local_at, reset
from filters.baselines import index_of
from filters.engine.belief import Belief, Kernels, filter_offset, memory_offsets
from filters.filter import Filter
from filters.gaussian import extended
from filters.gaussian.blending import Parts, blender, parts_of, weigher
from filters.gaussian.extended import ExtendedKalmanFilter
from filters.gaussian.sigma_points import checked_corners, memberships, rules_at_corners
from filters.pages.kernels import (
    Stage,
    anything_measured,
    as_tuple,
    nothing_to_summarise,
    page_kernels,
    prior_start,
    programs_of,
    stored,
    works_of,
)
from filters.pages.page import ACTING, Equations, PagedModel, RowMemory
from thruster_env.core.checks import at_least, one_of, short_repr
from thruster_env.model.affine import AffineModel
from thruster_env.model.shape import Functions, Shape
from thruster_env.model.turns import tangent_flags

Shapes = tuple[tuple[str, tuple[int, ...]], ...]  # of parameters, by name
FEWEST_PARTS, MOST_PARTS = 7, 1000
REACH = 4.5  # of the outermost parts, in standard deviations of the split component
OVERLAP = 0.6  # standard deviation of a part, over the distance from one to the next
BLENDINGS = ("weights", "moments", "output")


class MixturePage(NamedTuple):
    """The functions of a filter with a mixture; `own` are a part's parameters.

    With `predict` each part is predicted, with a weight that follows from the belief before. Without it the
    extended filter predicts the belief, and an update splits it and multiplies the weights by likelihoods.
    """

    represent: Callable  # represent(model, x, P): the weights of all parts, and further matrices that they share
    update: Callable  # update(model, own, *shared, x, P, z), of a part
    predict: Callable | None = None  # predict(model, own, *shared, x, P, u), of a part
    afresh: bool = True  # whether each prediction of a part begins with the belief, not with the part's last state
    between: bool = True  # whether the covariance includes differences between the parts' means
    fixed: tuple[tuple[str, Any], ...] = ()  # constants in `model.own` besides parameters


@lru_cache(maxsize=64)
def mixture_kernels(
    page: MixturePage,
    functions: Functions,
    shape: Shape,
    parameters: Shapes,
    count: int,
    own_shape: tuple[int, ...],
) -> Kernels:
    """Kernels for `count` parts, each with parameters in the shape `own_shape`, after the parameters of all parts.

    Extras: mean, covariance, innovation, its covariance and log-likelihood of each part; then the weights.
    """
    n, m, t, prior = shape.n, shape.m, shape.t, prior_start(shape)
    layout, belief, length, wide = (
        memory_offsets(n, m, t),
        n + t * t,
        prod(own_shape),
        max(shape.inputs, shape.channels),
    )
    level = belief + m + m * m
    acting, feed = layout.extras, shape.feed  # the input of the last step, if h takes it
    parts = Parts(acting + feed, level + 1, count)
    first, stride, _ = parts
    weights = first + count * stride
    inputs_offset = weights + count  # of u or z, a part's parameters, and the matrices that all parts share
    plain = ExtendedKalmanFilter.page._replace(own=parameters, fixed=page.fixed)
    memory = RowMemory(shape, plain)
    memory.end = inputs_offset + wide + length
    begun = as_tuple(page.represent(PagedModel(memory), memory.x, memory.P))
    shared = [memory.another(matrix) for matrix in begun[1:]]
    acting_now = memory.another(memory.read("rows", acting, feed)) if feed else None
    outputs = (layout.innovation, m), (layout.innovation_cov, m, m)
    v, S = (memory.read("rows", *output) for output in outputs)
    z, measured_turns = memory.z, shape.measured_turns
    z = innovation(z, z, measured_turns) if measured_turns else z  # of which only NaN matter
    begin, density = works_of(
        stored(begun, (weights, *shared)),
        stored((log_density(v, S, present(z)),), (layout.log_likelihood,)),
    )

    def stages(memory: RowMemory, model: Equations) -> list[Stage]:
        x, P = memory.read("rows", 0, n), memory.read("rows", n, t, t, symmetric=True)
        u, z, of_part = memory.u, memory.z, [memory.read("given", wide, *own_shape)]
        of_part += [memory.read("given", matrix.operation.at - inputs_offset, *matrix.shape) for matrix in shared]
        if acting_now is not None:
            model.extras = {ACTING: memory.read("given", acting_now.operation.at - inputs_offset, feed)}
        predicted = page.predict(model, *of_part, x, P, u) if page.predict else ()
        updated, offsets = page.update(model, *of_part, x, P, z), (x, P, belief, belief + m, level)
        return [stored(predicted, (x, P)[: len(predicted)]), stored(updated, offsets[: len(updated)])]

    predict_part, update_part = programs_of(plain, functions, shape, stages).works
    of_states = blender(parts, n, 0, n, shape.state_angles, between=page.between, turns=shape.turns)
    angles = tangent_flags(shape.measurement_angles, shape.measured_turns)
    of_innovations = blender(parts, m, belief, belief + m, angles, between=page.between, wraps=False)
    weigh, of_belief = weigher(parts, level), page_kernels(ExtendedKalmanFilter.page, functions, shape)
    step_offset, innovation_offset, likelihood_offset = layout.step, layout.innovation, layout.log_likelihood
    own_first, end, afresh = filter_offset(shape) + plain.own_size, memory.end, page.afresh
    seen_offset = end - feed

    def begin_afresh(row):
        for k in range(count):
            for i in range(belief):
                row[first + k * stride + i] = row[i]

    def each(work: Callable) -> Callable:
        def run(row, values, numbers):
            for i in range(values.shape[0]):
                row[inputs_offset + i] = values[i]
            for i in range(feed):
                row[seen_offset + i] = row[acting + i]
            for k in range(count):
                for i in range(length):
                    row[inputs_offset + wide + i] = numbers[own_first + k * length + i]
                work(row[first + k * stride : first + (k + 1) * stride], row[inputs_offset:end], numbers)

        return run

    predict_each, update_each = each(predict_part), each(update_part)

    def start(memory, numbers, size):
        row, _, _ = memory
        prior(memory, numbers, size)
        for i in range(acting, end):
            row[i] = 0.0

    def start_parts(memory, numbers, size):
        start(memory, numbers, size)
        begin_afresh(memory[0])
        begin(memory[0], memory[0], numbers)

    def predict(memory, u, numbers, size):
        row, _, _ = memory
        for i in range(feed):
            row[acting + i] = u[i]
        begin(row, u, numbers)
        if afresh:
            begin_afresh(row)
        predict_each(row, u, numbers)
        of_states(row, weights, 0)
        row[step_offset] += 1.0

    def update(memory, z, numbers, size):
        row, _, _ = memory
        update_each(row, z, numbers)
        of_innovations(row, weights, innovation_offset)
        density(row, z, numbers)
        of_states(row, weights, 0)

    def split_and_update(memory, z, numbers, size):
        row, _, _ = memory
        begin(row, z, numbers)
        begin_afresh(row)
        update_each(row, z, numbers)
        of_innovations(row, weights, innovation_offset)
        row[likelihood_offset] = 0.0
        if anything_measured(z):
            row[likelihood_offset] = weigh(row, weights)
            of_states(row, weights, 0)

    works = (start_parts, predict, update) if page.predict else (start, of_belief.predict, split_and_update)
    return Kernels(
        *(n, m, n, 0, *works, nothing_to_summarise),
        extras=inputs_offset - acting,
        scratch=end - inputs_offset,
        acting=tuple(range(acting, first)),
        turns=len(shape.turns),
        measured_turns=len(shape.measured_turns),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class MixtureFilter(Filter):
    """Base of filters that have a page for the parts of a mixture.

    Attributes:
        page: the functions.
        takes_rotations: whether it is written with the steps of a state that has rotations.
    """

    page: ClassVar[MixturePage]
    takes_rotations: ClassVar[bool] = False

    @cached_property
    def parameters(self) -> Mapping[str, Any]:
        """Numbers and arrays that the page reads from `model.own`."""
        raise NotImplementedError

    @cached_property
    def of_parts(self) -> np.ndarray:
        """The parameters of each part, (parts,) or (parts, length)."""
        raise NotImplementedError

    @property
    def written_page(self) -> MixturePage:
        """The page, adapted to the filter's fields."""
        return self.page

    @cached_property
    def own_parameters(self) -> tuple[float, ...]:
        """The parameters of all parts, then those of each part."""
        arrays = *self.parameters.values(), self.of_parts
        return tuple(float(number) for array in arrays for number in np.ravel(array))

    def kernels(self) -> Kernels:
        """Kernels of the page for the model's functions; see `Filter.kernels`."""
        model = self.kernel_model
        shapes = tuple((name, np.shape(array)) for name, array in self.parameters.items())
        count, *own_shape = np.shape(self.of_parts)
        shape = model.any_shape if self.takes_rotations else model.shape
        return mixture_kernels(self.written_page, model.functions, shape, shapes, count, tuple(own_shape))

    def part_estimates(self, belief: Belief) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means (parts, n), covariances (parts, t, t) and weights (parts,) of the parts of a belief."""
        feed, model = self.kernel_model.any_shape.feed, self.model
        return parts_of(belief.extras[feed:], len(self.of_parts), model.n, model.t)


def split(model, x, P):
    """Weights of the parts before a measurement, and the direction g = P e/sqrt(e' P e) of the split."""
    e = model.own.unit
    variance = dot(e, P @ e)
    return model.own.weights, P @ e * choose(exceeds(variance, 0.0), variance**-0.5, variance * 0.0)


def update_gaussian_sum(model, t, g, x, P, z):
    """The part at the node t, after the measurement z."""
    P = reset(model, P - outer(g, g) * model.own.narrower, x, g * t)
    x = added(model, x, g * t)
    local, z = local_at(model, z, x)
    return extended.update(local, x, P, z)


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianSumFilter(MixtureFilter):
    """Gaussian sum filter: an extended filter whose belief is a sum of Gaussians within each update.

        predict: the extended filter's
        split:   along g = P e_i/sqrt(P_ii), the regression of the state on its component i, into parts
                 N(mean + t_k g, P - (1 - s^2) g g') of weight a_k; the sum of a_k N(t_k, s^2), s < 1, has mean 0
                 and variance 1, so that mean and covariance of the belief are unchanged
        update:  each part by the extended filter, with h and H at its own mean;
                 its weight becomes a_k N(z; h(x_k), S_k)/L,  L = sum of a_k N(z; h(x_k), S_k)
        merge:   mean and P of the weighted parts: P within the parts and between them

    So a measurement may have several solutions in component i; a single linearisation at the mean finds only one.
    The log-likelihood is log L; innovation and S are those of the mixture before the measurement. On an affine
    model the estimate differs from the Kalman filter's by some thousandths of a standard deviation, because the
    sum has thinner tails than a Gaussian.

    `Belief.extras` holds the results of the last update for each part: mean, covariance, innovation, its
    covariance and its log-likelihood; then the weights. `part_estimates` returns them.

    Attributes:
        parts: number of Gaussians, at least 7.
        component: index i of the component along which the belief is split; -1 is the last.

    Raises:
        ValueError: if parts or component is out of its range.

    Source: Alspach, Sorenson (1972), "Nonlinear Bayesian estimation using Gaussian sum approximations"; splitting
    along one direction: Faubel, McDonough, Klakow (2009), "The split and merge unscented Gaussian mixture filter".
    """

    name: ClassVar[str] = "gsf"
    page: ClassVar[MixturePage] = MixturePage(split, update_gaussian_sum)
    takes_rotations: ClassVar[bool] = True
    gaussian_likelihood: ClassVar[bool] = False
    parts: int = 15
    component: int = -1

    def __post_init__(self):
        object.__setattr__(self, "parts", at_least("parts", self.parts, FEWEST_PARTS, MOST_PARTS))
        object.__setattr__(self, "component", index_of("component", self.component, self.model.t))

    @cached_property
    def standard_split(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Nodes t (parts,), weights a (parts,) and variance s^2 of a sum of Gaussians like N(0, 1)."""
        nodes = np.linspace(-REACH, REACH, self.parts)
        variance = (OVERLAP * (nodes[1] - nodes[0])) ** 2
        weights = np.exp(-0.5 * nodes**2)
        weights /= weights.sum()
        return nodes * np.sqrt((1.0 - variance) / (weights @ nodes**2)), weights, float(variance)

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """The unit vector of the component, 1 - s^2, and the weights."""
        _, weights, variance = self.standard_split
        return {"unit": np.eye(self.model.t)[self.component], "narrower": 1.0 - variance, "weights": weights}

    @cached_property
    def of_parts(self) -> np.ndarray:
        """The nodes."""
        return self.standard_split[0]


def initial_weights(model, x, P):
    """Weights of the rules, at the last estimate."""
    return memberships(x, model.own.low, model.own.high, model.own.premises)


def predict_fuzzy(model, c, x, P, u):
    """Predict by the Kalman filter of a rule, whose affine model has the constants c."""
    return extended.add_process_noise(model, *extended.propagate(model.at(c), x, P, u))


def update_fuzzy(model, c, x, P, z):
    """Update with the measurement z by the Kalman filter of a rule."""
    return extended.update(model.at(c), x, P, z)[:-1]  # memberships, not likelihoods, are the weights


@dataclass(frozen=True, kw_only=True, eq=False)
class FuzzyKalmanFilter(MixtureFilter):
    """Takagi-Sugeno fuzzy Kalman filter: 2^k Kalman filters, one for each corner of the range of k states.

        rule r:  if each of these states is low or high, as the bits of r say, then x' = A_r x + B_r u + a_r + w,
                 z = C_r x + d_r + v: the model linearised at that corner, Q and R the model's
        w_r:     product over i of (high_i - x_i)/(high_i - low_i) or (x_i - low_i)/(high_i - low_i), each within
                 0 and 1, of the last estimate x (`sigma_points.memberships`)
        predict: mean_r = A_r mean + B_r u + a_r,  P_r = A_r P A_r' + Q, from the common mean and P
        update:  the Kalman filter's of each rule, from its mean_r and P_r, with a gain of its own (Joseph's form)
        blend:   mean = sum of w_r mean_r,  P = sum of w_r P_r: the belief after each of the two

    These are the equations of `blending` "weights", the recursion of the sources. It ignores the differences
    between the rules' means, so P is too small. "moments" has P = sum of w_r (P_r + (mean_r - mean)(mean_r -
    mean)'): the first-order generalised pseudo-Bayesian filter, GPB1, with memberships in place of the models'
    probabilities. With "output" each rule continues from its own mean_r and P_r, which are blended, by moments,
    for output only. Innovation and S are blended like mean and P. If all rules are equal, as for an affine model,
    each blending is the Kalman filter.

    A blend of linearisations at the corners approximates a model only if the range is narrow: on the thruster the
    extended filter, which linearises at the estimate, is far better. `rule_estimates` returns the rules' moments.

    Attributes:
        low: the smallest states (n,); the model's `state_low` if None.
        high: the largest states (n,); the model's `state_high` if None.
        blending: "weights", "moments" or "output", see above.
        premises: indices of the states that the rules depend on, at most 8; if None, all of up to 8 states, or the
            first state of a larger affine model. Rules are linearised at the middle of the range of other states.
        offsets: whether rules have the offset a_r that makes them exact at their corners; the sources have none.

    Raises:
        ValueError: if the range of the states is unknown or empty, or a choice is not one of those above.

    Source: Ngatini, Apriliani, Nurhadi (2017), "Ensemble and fuzzy Kalman filter for position estimation of an
    autonomous underwater vehicle", Expert Systems with Applications 68, for the recursion and the memberships of
    minima and maxima (whose names are exchanged in the authors' slides); Takagi, Sugeno (1985), "Fuzzy
    identification of systems and its applications to modeling and control", for the rules; Simon (2003), "Kalman
    filtering for fuzzy discrete time dynamic systems", for filters by rule; Bar-Shalom, Li, Kirubarajan (2001),
    Estimation with Applications to Tracking and Navigation, section 11.6, for GPB1 and autonomous filters.
    """

    name: ClassVar[str] = "fuzzy"
    page: ClassVar[MixturePage] = MixturePage(initial_weights, update_fuzzy, predict_fuzzy)
    one_model: ClassVar[bool] = False
    any_step: ClassVar[bool] = False
    low: Any = None
    high: Any = None
    blending: str = "weights"
    offsets: bool = True
    premises: Any = None
    rule_estimates = MixtureFilter.part_estimates

    def __post_init__(self):
        one_of("blending", self.blending, BLENDINGS)
        if not isinstance(self.offsets, bool):
            raise ValueError(f"offsets must be True or False, but got {short_repr(self.offsets)}")
        for name, value in checked_corners(self.model, self.low, self.high, self.premises).items():
            object.__setattr__(self, name, value)

    @cached_property
    def rules(self) -> tuple[AffineModel, ...]:
        """The affine model of each rule."""
        return rules_at_corners(self.model, self.low, self.high, self.premises, self.offsets)

    @property
    def kernel_model(self) -> AffineModel:
        """The model of the first rule; all have its noise and prior."""
        return self.rules[0]

    @property
    def written_page(self) -> MixturePage:
        """The page of the blending."""
        afresh = self.blending != "output"  # each step begins with the common mean and P
        between = self.blending != "weights"  # differences between the rules' means count in P
        return self.page._replace(afresh=afresh, between=between, fixed=(("premises", self.premises),))

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """The range."""
        return {"low": self.low, "high": self.high}

    @cached_property
    def of_parts(self) -> np.ndarray:
        """The constants of the rules' models."""
        return np.array([rule.constants for rule in self.rules])
