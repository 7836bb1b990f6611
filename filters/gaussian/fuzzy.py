"""The Takagi-Sugeno fuzzy Kalman filter: one Kalman filter a rule, blended by memberships of the state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from typing import Any, ClassVar

import numpy as np

from filters.baselines.baselines import place_of
from filters.engine.belief import Belief, Kernels
from filters.engine.layout import memory_places, own_place, row_access
from filters.filter import Filter
from filters.gaussian.mixture import blender, rule_programs
from filters.pages.kernels import nothing_to_summarise, prior_start
from thruster_env.numerics import matrices
from thruster_env.numerics.checks import one_of, short_repr, vector
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.sources import tuple_of, written_out
from thruster_env.numerics.tuples import vector_reader
from thruster_env.plants.affine import AffineModel, affine_functions, linearize
from thruster_env.plants.layout import number_places
from thruster_env.plants.shape import Functions, Shape

MOST_STATES = 8  # that rules ask for: 256 rules
BLENDINGS = ("weights", "moments", "output")


@cache
def memberships(premises: tuple[int, ...]) -> Callable:
    """Return `weigh(x, low, high)`: memberships of the state x in the 2^k rules, a tuple that sums to one.

    That of rule r is the product over all k premises i of (high_i - x_i)/(high_i - low_i), or of one less that
    where the bit of r that belongs to i is set; each factor is held within 0 and 1.
    """
    lines: list[str] = []
    products: list[tuple[str, ...]] = []
    for i in premises:
        lines.append(f"part = (x[{i}] - low[{i}]) / (high[{i}] - low[{i}])")
        lines.append(f"of_high{i} = 0.0 if part < 0.0 else 1.0 if part > 1.0 else part")
        lines.append(f"of_low{i} = 1.0 - of_high{i}")
        longer = [
            " * ".join([*product, f"{end}{i}"]) for end in ("of_low", "of_high") for product in products or [()]
        ]
        names = [f"w{i}_{rule}" for rule in range(len(longer))]
        lines += [f"{name} = {source}" for name, source in zip(names, longer, strict=True)]
        products = [(name,) for name in names]
    return written_out("weigh", "x, low, high", *lines, tuple_of(names))


@lru_cache(maxsize=64)
def fuzzy_kernels(shape: Shape, blending: str, premises: tuple[int, ...]) -> Kernels:
    """Kernels for a shape, one of `BLENDINGS` and the states that rules ask for; the rules' models are numbers.

    Extras: `rule_length` numbers a rule.
    """
    n, m, inputs = shape.n, shape.m, shape.inputs
    places, source, own = memory_places(n, m), number_places(n, m), own_place(shape)
    step_place, likelihood_place, rules, stride = (
        places.step,
        places.log_likelihood,
        2 ** len(premises),
        rule_length(n, m),
    )
    mean_place, first = places.mean, places.extras
    weights, seen = first + n + n * n, first + n + n * n + 1
    between, restarts = blending != "weights", blending != "output"
    of_states = blender(n, first, first + n, weights, stride, shape.state_angles, between)
    of_innovations = blender(m, seen, seen + m, weights, stride, shape.measurement_angles, between)
    length, belief, prior = n * (n + inputs + 1) + m * (n + 1), n + n * n, source.prior_mean
    functions = Functions(**affine_functions(n, m, inputs))
    predict_rule, update_rule = rule_programs(functions, shape._replace(form=length))
    models, low, high = own + 2 * n, vector_reader(n, own), vector_reader(n, own + n)
    given_place = first + rules * stride
    weigh = memberships(premises)
    store_weights = written_out(
        "store_weights", "row, w", *(f"row[{weights + stride * r}] = w[{r}]" for r in range(rules)), "None"
    )
    (read_mean, _), (store_mean, store_cov), (store_innovation, store_s) = row_access(shape)
    factor, likelihood, measured = (
        matrices.cholesky_factor(m),
        matrices.innovation_likelihood(m),
        vector_reader(m),
    )
    start_gaussian = prior_start(shape)

    @inlined
    def take_memberships(row, numbers):
        store_weights(row, weigh(read_mean(row), low(numbers), high(numbers)))

    @inlined
    def blend(row):
        mean, cov = of_states(row, rules)
        store_mean(row, mean)
        store_cov(row, cov)

    @inlined
    def rule_and_given(row, numbers, j, values):
        """The memory of a rule; and its model's constants with u or z, behind all rules."""
        given = row[given_place : given_place + length + values.shape[0]]
        for i in range(length):
            given[i] = numbers[models + j * length + i]
        for i in range(values.shape[0]):
            given[length + i] = values[i]
        return row[first + j * stride : first + (j + 1) * stride], given

    @inlined
    def start(memory, numbers, size):
        row, _, _ = memory
        start_gaussian(memory, numbers, size)
        for j in range(rules):
            for i in range(belief):
                row[first + j * stride + i] = numbers[prior + i]
        take_memberships(row, numbers)

    @inlined
    def predict(memory, u, numbers, size):
        row, _, _ = memory
        take_memberships(row, numbers)
        for j in range(rules):
            rule, given = rule_and_given(row, numbers, j, u)
            if restarts:
                for i in range(belief):
                    rule[i] = row[mean_place + i]
            predict_rule(rule, given, numbers)
        blend(row)
        row[step_place] += 1.0

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        for j in range(rules):
            rule, given = rule_and_given(row, numbers, j, z)
            update_rule(rule, given, numbers)
        blend(row)
        innovation, s = of_innovations(row, rules)
        store_innovation(row, innovation)
        store_s(row, s)
        row[likelihood_place] = likelihood(innovation, factor(s), measured(z))

    scratch = length + max(inputs, m)
    return Kernels(
        n, m, n, 0, start, predict, update, nothing_to_summarise, extras=rules * stride, scratch=scratch
    )


def rule_length(n: int, m: int) -> int:
    """Numbers that are kept of a rule: mean, covariance, membership, innovation, its covariance."""
    return n + n * n + 1 + m + m * m


@dataclass(frozen=True, kw_only=True, eq=False)
class FuzzyKalmanFilter(Filter):
    """Takagi-Sugeno fuzzy Kalman filter: 2^k Kalman filters, one for each corner of the range of k states.

        rule r:  if each of these states is low or high, as the bits of r say, then x' = A_r x + B_r u + a_r + w,
                 z = C_r x + d_r + v: the model linearised at that corner, Q and R the model's
        w_r:     product over i of (high_i - x_i)/(high_i - low_i) or (x_i - low_i)/(high_i - low_i), each within
                 0 and 1, of the last estimate x
        predict: mean_r = A_r mean + B_r u + a_r,  P_r = A_r P A_r' + Q, from the common mean and P
        update:  the Kalman filter's of each rule, from its mean_r and P_r, with a gain of its own (Joseph's form)
        blend:   mean = sum of w_r mean_r,  P = sum of w_r P_r: the belief after each of the two

    `blending` "weights" is this, the recursion of the sources. It ignores the differences between the rules'
    means, so P is too small. "moments" is the same with P = sum of w_r (P_r + (mean_r - mean)(mean_r - mean)'):
    the first-order generalised pseudo-Bayesian filter, GPB1, with memberships in place of the models'
    probabilities. "output" has autonomous filters: each rule continues from its own mean_r and P_r, which are
    blended, by moments, for output only. Innovation and S are blended as mean and P are. With equal rules, as an
    affine model has them, all three are the Kalman filter.

    A blend of linearisations at the corners approximates a model only if the range is narrow: on the thruster the
    extended filter, which linearises at the estimate, is far better.

    `Belief.extras` holds for each rule its mean, covariance, membership, innovation and the innovation's
    covariance; `rule_estimates` takes them apart.

    Attributes:
        low: the smallest states (n,); the model's `state_low` if None.
        high: the largest states (n,); the model's `state_high` if None.
        blending: "weights", "moments" or "output", see above.
        premises: indices of the states that the rules depend on, at most 8; if None, all of up to 8 states, or the
            first state of a larger affine model. Rules are linearised at the middle of the range of other states.
        offsets: whether rules have the offset a_r that makes them exact at their corners; the sources print none.

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
    one_model: ClassVar[bool] = False
    any_step: ClassVar[bool] = False
    low: Any = None
    high: Any = None
    blending: str = "weights"
    offsets: bool = True
    premises: Any = None

    def __post_init__(self):
        """Check the range and the choices; raise ValueError that states the rule and the value."""
        model = self.model
        one_of("blending", self.blending, BLENDINGS)
        if not isinstance(self.offsets, bool):
            raise ValueError(f"offsets must be True or False, but got {short_repr(self.offsets)}")
        object.__setattr__(self, "premises", self._checked_premises())
        low = model.state_low if self.low is None else self.low
        high = model.state_high if self.high is None else self.high
        if isinstance(model, AffineModel):  # its rules are all alike, whatever the range
            low = model.prior_mean - model.scales if low is None else low
            high = model.prior_mean + model.scales if high is None else high
        if low is None or high is None:
            raise ValueError(
                "a fuzzy filter must know the range of the states, but got neither low and high nor "
                "a model with state_low and state_high"
            )
        low, high = vector("low", low, model.n), vector("high", high, model.n)
        if not (low < high).all():
            raise ValueError(
                f"low must be below high in every state, but got {short_repr(low)} and {short_repr(high)}"
            )
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    def _checked_premises(self) -> tuple[int, ...]:
        """Places of the states that rules ask for."""
        n, given = self.model.n, self.premises
        if given is None and n > MOST_STATES and isinstance(self.model, AffineModel):
            given = (0,)  # all rules are alike
        given = range(n) if given is None else given
        try:
            places = tuple(place_of("premises", place, n) for place in given)
        except TypeError:
            places = ()
        if not 1 <= len(places) <= MOST_STATES or len(set(places)) < len(places):
            rule = f"premises must name 1 to {MOST_STATES} different states, for there is a rule for each corner"
            count = f"all {n} states" if self.premises is None else short_repr(self.premises)
            raise ValueError(f"{rule} of their range, but got {count}")
        return places

    @cached_property
    def rules(self) -> tuple[AffineModel, ...]:
        """The affine model of each rule."""
        model = self.model
        control = np.zeros(model.inputs) if model.operating_input is None else model.operating_input
        rules = (linearize(model, self._corner(rule), control) for rule in range(2 ** len(self.premises)))
        return tuple(rules) if self.offsets else tuple(_without_offset(rule) for rule in rules)

    def _corner(self, rule: int) -> np.ndarray:
        """The state (n,) about which a rule is linearised: its bits say of each premise whether it is high."""
        corner = (self.low + self.high) / 2
        for bit, i in enumerate(self.premises):
            corner[i] = (self.high if rule >> bit & 1 else self.low)[i]
        return corner

    @property
    def own_parameters(self) -> tuple[float, ...]:
        """The range, then the rules' models."""
        return (*self.low, *self.high, *(number for rule in self.rules for number in rule.constants))

    def kernels(self) -> Kernels:
        """Kernels for the model's shape; see `Filter.kernels`."""
        return fuzzy_kernels(self.kernel_model.shape, self.blending, self.premises)

    def rule_estimates(self, belief: Belief) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means (2^k, n), covariances (2^k, n, n) and memberships (2^k,) of the rules of a belief."""
        n = self.model.n
        means, covs, weights, _ = np.split(
            belief.extras.reshape(2 ** len(self.premises), -1), [n, n + n * n, n + n * n + 1], axis=1
        )
        return means.copy(), covs.reshape(-1, n, n).copy(), weights[:, 0].copy()


def _without_offset(rule: AffineModel) -> AffineModel:
    """The rule x' = A x + B u, z = C x + d."""
    before, count = rule.n * (rule.n + rule.inputs), rule.n
    c = rule.constants
    return rule.replace(constants=c[:before] + (0.0,) * count + c[before + count :])
