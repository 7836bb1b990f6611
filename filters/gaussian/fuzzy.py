"""The Takagi-Sugeno fuzzy Kalman filter: one Kalman filter a rule, blended by memberships of the state."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from filters.gaussian import extended
from filters.gaussian.mixture_filter import MixtureFilter, MixturePage
from filters.gaussian.rules import checked_corners, memberships, rules_at_corners
from thruster_env.core.checks import one_of, short_repr
from thruster_env.model.affine import AffineModel

BLENDINGS = ("weights", "moments", "output")


def begin(model, x, P):
    """Weights of the rules, at the last estimate."""
    return memberships(x, model.own.low, model.own.high, model.own.premises)


def predict(model, c, x, P, u):
    """The Kalman filter of a rule, whose affine model has the constants c."""
    return extended.settle(model, *extended.advance(model.at(c), x, P, u))


def update(model, c, x, P, z):
    """The measurement z, by a rule."""
    return extended.update(model.at(c), x, P, z)[:-1]  # memberships, not likelihoods, are the weights


@dataclass(frozen=True, kw_only=True, eq=False)
class FuzzyKalmanFilter(MixtureFilter):
    """Takagi-Sugeno fuzzy Kalman filter: 2^k Kalman filters, one for each corner of the range of k states.

        rule r:  if each of these states is low or high, as the bits of r say, then x' = A_r x + B_r u + a_r + w,
                 z = C_r x + d_r + v: the model linearised at that corner, Q and R the model's
        w_r:     product over i of (high_i - x_i)/(high_i - low_i) or (x_i - low_i)/(high_i - low_i), each within
                 0 and 1, of the last estimate x (`rules.memberships`)
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
    extended filter, which linearises at the estimate, is far better. `rule_estimates` takes a belief apart.

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
    page: ClassVar[MixturePage] = MixturePage(begin, update, predict)
    one_model: ClassVar[bool] = False
    any_step: ClassVar[bool] = False
    low: Any = None
    high: Any = None
    blending: str = "weights"
    offsets: bool = True
    premises: Any = None
    rule_estimates = MixtureFilter.part_estimates

    def __post_init__(self):
        """Check the range and the choices; raise ValueError that states the rule and the value."""
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
