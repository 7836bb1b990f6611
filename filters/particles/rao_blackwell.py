"""The Rao-Blackwellised particle filter: some states are sampled, a Kalman filter per particle has the others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from filters.algebra.blocks import hstack, pick, zeros
from filters.algebra.members import on_branch
from filters.algebra.operations import sym, wrap
from filters.algebra.points import outer, root, square
from filters.algebra.samples import weighted_covariance, weighted_mean, weights
from filters.baselines.baselines import places_of
from filters.engine.belief import Belief
from filters.gaussian import extended
from filters.pages.page_filter import Page
from filters.particles.weighted import ResampledFilter
from thruster_env.core.streams import FILTER_PROPOSAL, GROUP, fill_normals
from thruster_env.model.layout import padded


def sample(x, P, e, sampled):
    """Draw the sampled states of N(x, P); mean and covariance of all, if these are known.

    With the sampled states first, P = [A 0; B C] [A 0; B C]', and [x_s; x_l] = mean + [A; B] e leaves C C'.
    """
    n, count = len(x), len(sampled)
    order = (*sampled, *(i for i in range(n) if i not in sampled))
    back, places = tuple(map(order.index, range(n))), tuple(range(n))
    L = root(pick(P, order, order))
    AB, C = pick(L, back, places[:count]), pick(L, back, places[count:])
    if count == n:
        return x + AB @ e, {"P": P * 0.0}
    return x + hstack(AB, zeros(P, n, n - count)) @ e, {"P": square(C)}  # of e the first ones count


def start(model, w):
    """A particle of the prior."""
    return sample(model.prior_mean, square(model.prior_root), w, model.own.sampled)


def advance(model, x, u):
    """One of the model's substeps."""
    x, P = extended.advance(model, x, model.kept["P"], u)
    return x, {"P": P}


def settle(model, x, w):
    """The end of a step."""
    x, P = extended.settle(model, x, model.kept["P"])
    x, kept = sample(x, P, w, model.own.sampled)
    return on_branch(x, model.state_angles), kept


def spread(model, x, mean, P, e):
    """Copies of a particle, whose sampled states get a kernel's covariance, of which the next step draws."""
    flags = model.own.flags
    return x, {"P": model.kept["P"] + sym(P * outer(flags, flags)) * model.own.kernel}


def update(model, x, log_w, z, e):
    """The measurement z; channels that are NaN are missing."""
    x, P, v, S, level = extended.update(model, x, model.kept["P"], z)
    w = weights(log_w)
    v = on_branch(v, model.measurement_angles, w)
    mean, cov = weighted_mean(v, w), weighted_covariance(v, w) + weighted_mean(S, w)
    return x, log_w + level, wrap(mean, model.measurement_angles), cov, {"P": P}


@dataclass(frozen=True, kw_only=True, eq=False)
class RaoBlackwellisedParticleFilter(ResampledFilter):
    """Rao-Blackwellised particle filter: some states are sampled, a Kalman filter per particle has the others.

    A particle is a mean x_j of all states and a P_j that is zero in the rows and columns of the sampled ones:

        predict: if ESS < threshold N, resample the particles by weight (systematic), and all w_j = 1/N;
                 regularised: P_j += (c h)^2 cov of the sampled states, h as in `ParticleFilter` for their number
                 x_j = f(x_j, u),  P_j = F_j P_j F_j' + Q,  F_j = df/dx at x_j
                 with the sampled states s first and l the others,  P_j = [A 0; B C] [A 0; B C]':
                 x_s += A e_j,  x_l += B e_j,  e_j ~ N(0, I),  P_j of l = C C'
        update:  each particle by the extended filter, with h and H at x_j;
                 w_j = w_j N(v_j; 0, S_j)/L,  L = sum of w_j N(v_j; 0, S_j)
        belief:  mean = sum of w_j x_j,
                 cov = sum of w_j P_j + sum of w_j (x_j - mean)(x_j - mean)'/(1 - sum of w_j^2)

    The Kalman filters are exact where, with the sampled states given, f and h are affine in the others, whatever
    Q: the joint P_j holds what the step of the sampled states tells of the others. There particles have to cover
    few states, and it takes fewer of them than `pf` does. Elsewhere each particle linearises by itself. If all
    states are sampled, this is `pf`.

    The log-likelihood is log L; innovation and S are those of the mixture before the measurement. `Belief.members`
    is (n + 1 + n^2, N): x_j, log weight, and P_j by rows, of which those on and below the diagonal are used.
    `Belief.extras` holds the ESS.

    Attributes:
        sampled: indices of the sampled states, at least one; -1 is the last.

    The other attributes are those of `ResampledFilter`, c its regularisation.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Schon, Gustafsson, Nordlund (2005), "Marginalized particle filters for mixed linear/nonlinear
    state-space models"; Doucet, de Freitas, Murphy, Russell (2000), "Rao-Blackwellised particle filtering for
    dynamic Bayesian networks".
    """

    name: ClassVar[str] = "rbpf"
    page: ClassVar[Page] = Page(advance, settle, update, start=start, renew=spread, of_each=("P",))
    unrolled: ClassVar[tuple[str, ...]] = ("sampled",)
    ensemble_size: int = 100
    sampled: Any = (0,)

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        places = places_of("sampled", self.sampled, self.model.n)
        if not places:
            raise ValueError("sampled must be a list of indices, at least one, but got none")
        object.__setattr__(self, "sampled", places)

    @property
    def spread_states(self) -> int:
        """How many states the kernel spreads."""
        return len(self.sampled)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """What the page and resampling read: of the kernel its share of the covariance of sampled states."""
        given = super().parameters
        return {**given, "kernel": given["width"] ** 2, "flags": [i in self.sampled for i in range(self.model.n)]}

    def sample(self, belief: Belief) -> np.ndarray:
        """A state (n, N) drawn from each particle's N(x_j, P_j), and the row of log weights."""
        n, size = self.model.n, self.ensemble_size
        values, vectors = np.linalg.eigh(self.particle_covariances(belief))
        draws = np.zeros(padded(n * size, GROUP))
        fill_normals(draws, n * size, belief.step, FILTER_PROPOSAL, *belief.key)
        e = np.sqrt(np.maximum(values, 0.0)) * draws[: n * size].reshape(size, n)
        drawn = belief.members[:n] + np.einsum("jab,jb->aj", vectors, e)
        return np.concatenate([drawn, belief.members[n : n + 1]])

    def particle_covariances(self, belief: Belief) -> np.ndarray:
        """The covariances P_j (N, n, n) of the particles of a belief."""
        n, size = self.model.n, self.ensemble_size
        lower = np.tril(belief.members[n + 1 :].reshape(n, n, size).transpose(2, 0, 1))
        return lower + np.tril(lower, -1).transpose(0, 2, 1)
