"""Particle filters: bootstrap, auxiliary, with the optimal proposal, and Rao-Blackwellised."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from filters.algebra.members import on_branch
from filters.algebra.operations import divide, mask_missing, present, sym, uncorrelated, wrap
from filters.algebra.points import (
    log_density,
    outer,
    root,
    square,
    weighted_covariance,
    weighted_mean,
    weighted_square,
    weights,
)
from filters.algebra.roots import hstack, pick, zeros
from filters.algebra.tangents import added, reset
from filters.baselines import indices_of
from filters.engine.belief import Belief, Kernels
from filters.ensembles.ensemble import add_process_noise, propagate
from filters.gaussian import extended
from filters.pages.page import Page
from filters.particles import kernels as weighted
from filters.particles.kernels import (
    ResampledFilter,
    WeightedFilter,
    draw,
    expect,
    fit,
    initial_weighted,
    particle_kernels,
    smooth,
    spread,
)
from thruster_env.core.checks import one_of
from thruster_env.core.streams import FILTER_PROPOSAL, GROUP, fill_normals
from thruster_env.model.shape import padded
from thruster_env.model.turns import move

PROPOSALS, RESAMPLINGS = ("prior", "optimal"), ("systematic", "gaussian")


def initial_auxiliary(model, w):
    """Draw a particle from the prior; its noise is zero."""
    return weighted.initial_weighted(model, w), {"noise": zeros(model.Q, len(w))}


def add_process_noise_auxiliary(model, x, w):
    """Add process noise at the end of a step, and keep it as an extra."""
    noise = model.Q_root @ w
    return on_branch(added(model, x, noise), model.state_angles), {"noise": noise}


def lookahead(model, x, log_w, z):
    """A particle without its noise, mu, then log N(z; h(mu), R + V), and innovation and S of all with noise."""
    measured, mu = present(z), added(model, x, -model.extras["noise"])
    y, v, S = expect(model, x, log_w, z)
    without = mask_missing(measured, model.h(mu))
    V = weighted_square(wrap(y - without, model.measurement_angles), weights(log_w))
    rest = mask_missing(measured, wrap(z - without, model.measurement_angles))
    return mu, log_density(rest, V + uncorrelated(measured, model.R), measured), v, S


def update_auxiliary(model, x, log_w, z, e):
    """Update resampled particles mu with the measurement z, after adding the noise of their new index.

    `log_w` is the logarithm of the mean of all lambda, over N(z; h(mu), R + V).
    """
    x = added(model, x, model.extras["noise"])  # the noise is not resampled
    return x, log_w + fit(model, mask_missing(present(z), model.h(x)), z), {"noise": zeros(model.Q, len(model.Q))}


@dataclass(frozen=True, kw_only=True, eq=False)
class AuxiliaryParticleFilter(WeightedFilter):
    """Auxiliary particle filter: parents are drawn by how well their noise-free prediction fits z.

        predict: mu_j = f(x_j, u),  x_j = mu_j + noise_j,  noise_j ~ N(0, Q); both are kept
        update:  V = sum of w_j (h(x_j) - h(mu_j))(h(x_j) - h(mu_j))'
                 lambda_j = w_j N(z; h(mu_j), R + V), parents i(j) drawn by lambda (systematic)
                 x_j = mu_i(j) + noise_j,  w_j = N(z; h(x_j), R)/N(z; h(mu_i(j)), R + V), normalised
                 regularised: x_j += c h e_j before it is weighed,  e_j ~ N(0, covariance of mu by lambda)
                 L = (sum of lambda_j) (mean of w_j before normalisation)
        belief:  mean = sum of w_j x_j,  cov = sum of w_j (x_j - mean)(x_j - mean)'/(1 - sum of w_j^2)

    The look-ahead needs the measurement, which is known in the update only. The prediction therefore keeps each
    particle's noise; the update removes it, draws parents by mu, and adds it again: the noise does not depend on
    the draw, as the method requires. Before an update a belief equals the bootstrap filter's. Directly after the
    prior or another update there is no noise, and parents are drawn by exact weights.

    V, the covariance that the noise causes in the measurement, bounds the weights w_j if the noise is large: with
    V = 0, the textbook choice, a few particles whose mu fitted badly would take all the weight.

    The log-likelihood is log L; innovation, S and restarts are the bootstrap filter's. `Belief.members` is
    (2 n + 1, N): particles, log weights, noise. `Belief.extras` holds the effective sample size.

    Attributes are those of `WeightedFilter`, c its regularisation and h as in `ParticleFilter`.

    Source: Pitt, Shephard (1999), "Filtering via simulation: auxiliary particle filters", section 3, where the
    first stage's density is free; the likelihood: Pitt (2002), "Smooth particle filters for likelihood evaluation
    and maximisation".
    """

    name: ClassVar[str] = "apf"
    page: ClassVar[Page] = Page(
        propagate,
        add_process_noise_auxiliary,
        update_auxiliary,
        initial=initial_auxiliary,
        rejuvenate=spread,
        lookahead=lookahead,
        per_particle=("noise",),
    )


def initial_optimal(model, w):
    """Draw a particle from the prior; its noise and the covariance of that are zero."""
    return weighted.initial_weighted(model, w), no_noise(model, len(w))


def no_noise(model, n):
    """Noise of zero, and a covariance of zero."""
    return {"noise_cov": sym(zeros(model.Q, n, n)), "noise": zeros(model.Q, n)}


def add_process_noise_optimal(model, x, w):
    """Add process noise at the end of a step, and keep it and its Q: Q may differ in a later update."""
    x, extras = add_process_noise_auxiliary(model, x, w)
    return x, {"noise_cov": model.Q, **extras}


def propose(model, x, d, Q, z, e):
    """Particles x = mu + d and their noise d ~ N(0, Q), drawn again given z; logarithms of their weights.

    Each d is conditioned on z as in a stochastic ensemble filter, with a perturbation of z for each particle: this
    turns a sample of the prior into one of the proposal. With Q = 0 nothing moves.
    """
    measured, mu = present(z), added(model, x, -d)
    H, R = mask_missing(measured, model.H(mu)), uncorrelated(measured, model.R)
    v = mask_missing(measured, wrap(z - model.h(mu), model.measurement_angles))
    S = sym(H @ Q @ H.T + R)
    d = d + divide(Q @ H.T, S) @ (v - H @ d - mask_missing(measured, model.R_root @ e))
    x = added(model, mu, d)
    rest = mask_missing(measured, wrap(z - model.h(x), model.measurement_angles))
    return x, d, log_density(v, S, measured) + log_density(rest, R, measured) - log_density(v - H @ d, R, measured)


def update_optimal(model, x, log_w, z, e):
    """Draw particles given the measurement z, and weigh them; NaN marks missing channels."""
    _, v, S = expect(model, x, log_w, z)
    x, d, level = propose(model, x, model.extras["noise"], model.extras["noise_cov"], z, e)
    return x, log_w + level, v, S, no_noise(model, len(model.Q))


OPTIMAL = Page(
    propagate, add_process_noise_optimal, update_optimal, initial=initial_optimal, per_particle=("noise",)
)


def update(model, x, log_w, z, e):
    """Weigh a particle by the measurement z; NaN marks missing channels."""
    y, v, S = expect(model, x, log_w, z)
    return x, log_w + fit(model, y, z), v, S


@dataclass(frozen=True, kw_only=True, eq=False)
class ParticleFilter(ResampledFilter):
    """Particle filter: importance sampling from the prediction, with systematic resampling.

        predict: if ESS < threshold N, resample the particles by weight (systematic), and all w_j = 1/N;
                 regularised: x_j += c h e_j,  e_j ~ N(0, cov),  h = (4/(n + 2))^(1/(n + 4)) N^(-1/(n + 4));
                 mu_j = f(x_j, u),  x_j = mu_j + noise_j,  noise_j ~ N(0, Q)
        update:  w_j = w_j p(z | x_j)/L,  L = sum of w_j p(z | x_j),  p(z | x) = N(z; h(x), R)
                 ESS = 1/(sum of w_j^2)
        belief:  mean = sum of w_j x_j,  cov = sum of w_j (x_j - mean)(x_j - mean)'/(1 - sum of w_j^2)

    This is the bootstrap filter. With the optimal proposal an update draws each particle again, given z:

        v_j = z - h(mu_j),  S_j = H_j Q H_j' + R,  K_j = Q H_j' S_j^-1,  H_j = dh/dx at mu_j
        noise_j += K_j (v_j - H_j noise_j - r_j),  r_j ~ N(0, R),  x_j = mu_j + noise_j
        w_j = w_j N(v_j; 0, S_j) N(z; h(x_j), R)/N(v_j; H_j noise_j, R), divided by their sum L

    If h is linear, x is drawn from p(x | x_before, z) with the weight p(z | x_before), which does not depend on
    the draw: fewer particles lose their weight if sensors are accurate compared with Q. Otherwise the proposal is
    that of an extended filter per particle, and the weight corrects the error of its tangent. It needs the noise
    of the prediction: directly after the prior or another update, an update is the bootstrap filter's.

    With `resampling` "gaussian" the filter draws particles from N(mean, cov) instead of resampling: with a
    threshold of 1 it is the Gaussian particle filter.

    If states are `smoothed`, the kernel spreads only these, and shrinks them towards their mean so that their
    covariance stays: x_j = m + a (x_j - m) + b e_j,  b = c h for as many states,  a = (1 - b^2)^(1/2). Use it for
    constants that are states of an `augmented_model` without a walk: resampling alone would soon leave only one of
    their values.

    The log-likelihood is log L. The innovation is z minus the weighted mean of h(x_j), and its covariance S the
    weighted covariance of h(x_j) plus R. Resampling waits for the next prediction, so that a belief has the
    moments of the weighted particles, without the noise of a draw. If two or three particles have all the weight,
    the covariance is nearly singular and the NEES (normalised estimation error squared) far too large: use more
    particles. If no particle has any weight, because the measurement is impossible under the model, the belief
    restarts from the prior, and `divergences` counts the restart.

    `Belief.members` is (n + 1, N), its last row the log weights; with the optimal proposal n rows of noise follow.
    `Belief.extras` holds the ESS, and then the Q of that noise.

    Attributes:
        proposal: "prior", or "optimal" to draw particles again, given z.
        resampling: "systematic", or "gaussian" to draw particles from N(mean, cov) instead.
        smoothed: indices of states that are constants, which only the kernel moves; -1 is the last. They need a
            regularisation of about 1.

    The other attributes are those of `ResampledFilter`, c its regularisation.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Gordon, Salmond, Smith (1993), "Novel approach to nonlinear/non-Gaussian Bayesian state estimation";
    Kitagawa (1996) for the resampling; Kong, Liu, Wong (1994) for the ESS; Musso, Oudjane, Le Gland (2001),
    "Improving regularised particle filters", for the regularisation, without their rescaling; Doucet, Godsill,
    Andrieu (2000), "On sequential Monte Carlo sampling methods for Bayesian filtering", for the optimal proposal;
    Kotecha, Djuric (2003), "Gaussian particle filtering"; Liu, West (2001), "Combined parameter and state
    estimation in simulation-based filtering", for smoothed constants.
    """

    name: ClassVar[str] = "pf"
    page: ClassVar[Page] = Page(propagate, add_process_noise, update, initial=initial_weighted, rejuvenate=spread)
    proposal: str = "prior"
    resampling: str = "systematic"
    smoothed: Any = ()

    def __post_init__(self):
        super().__post_init__()
        one_of("proposal", self.proposal, PROPOSALS)
        one_of("resampling", self.resampling, RESAMPLINGS)
        object.__setattr__(self, "smoothed", indices_of("smoothed", self.smoothed, self.model.t))
        if self.regularisation and self.resampling == "gaussian":
            raise ValueError("a filter that draws from a Gaussian must have no regularisation, but got one")

    @property
    def spread_states(self) -> int:
        """How many states the kernel spreads."""
        return len(self.smoothed) or self.model.t

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The parameters of the page and of resampling; for smoothed states `width` is b, and `drawn` is 1 - a."""
        parameters = super().parameters
        if not self.smoothed:
            return parameters
        width = min(parameters["width"], 1.0)
        flags = [float(i in self.smoothed) for i in range(self.model.t)]
        return {**parameters, "width": width, "drawn": 1.0 - (1.0 - width**2) ** 0.5, "smoothed": flags}

    @property
    def written_page(self) -> Page:
        """The page of the choices."""
        page = super().written_page
        if self.proposal == "optimal":
            page = OPTIMAL._replace(rejuvenate=page.rejuvenate, own=page.own)
        if self.resampling == "gaussian":
            return page._replace(rejuvenate=draw)
        return page._replace(rejuvenate=smooth) if self.smoothed and self.regularisation else page

    def kernels(self) -> Kernels:
        """Kernels of the page for the model's functions; see `Filter.kernels`."""
        resample = self.resampling == "systematic"
        return particle_kernels(self.written_page, self.kernel_model.functions, self.shape, resample)


def sample(model, x, P, e, sampled):
    """Draw the sampled states from N(x, P); return mean and covariance of all states given these.

    With the sampled states first, P = [A 0; B C] [A 0; B C]'; given x_s the mean is x + [A; B] e and the
    covariance of the others C C'.
    """
    n, count = len(P), len(sampled)
    order = (*sampled, *(i for i in range(n) if i not in sampled))
    back, indices = tuple(map(order.index, range(n))), tuple(range(n))
    L = root(pick(P, order, order))
    AB, C = pick(L, back, indices[:count]), pick(L, back, indices[count:])
    if count == n:
        return added(model, x, AB @ e), {"P": P * 0.0}
    d = hstack(AB, zeros(P, n, n - count)) @ e  # only the first entries of e are used
    return added(model, x, d), {"P": reset(model, square(C), x, d)}


def initial_rao_blackwell(model, w):
    """Draw a particle from the prior."""
    return sample(model, model.prior_mean, square(model.prior_root), w, model.own.sampled)


def propagate_rao_blackwell(model, x, u):
    """Propagate a particle's mean and covariance by one substep."""
    x, P = extended.propagate(model, x, model.extras["P"], u)
    return x, {"P": P}


def add_process_noise_rao_blackwell(model, x, w):
    """Add Q at the end of a step, and draw the sampled states."""
    x, P = extended.add_process_noise(model, x, model.extras["P"])
    x, extras = sample(model, x, P, w, model.own.sampled)
    return on_branch(x, model.state_angles), extras


def spread_rao_blackwell(model, x, mean, P, e):
    """Add a kernel's covariance to the sampled states of a resampled particle; the next step draws from it."""
    flags = model.own.flags
    return x, {"P": model.extras["P"] + sym(P * outer(flags, flags)) * model.own.kernel}


def update_rao_blackwell(model, x, log_w, z, e):
    """Update each particle by the extended filter with the measurement z; NaN marks missing channels."""
    x, P, v, S, level = extended.update(model, x, model.extras["P"], z)
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

    The Kalman filters are exact if f and h are affine in the other states, given the sampled ones, for any Q: the
    joint P_j contains the information that a step of the sampled states has on the others. Then particles have to
    cover only few states, and fewer are enough than for `pf`. Otherwise each particle linearises by itself. If all
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
    page: ClassVar[Page] = Page(
        propagate_rao_blackwell,
        add_process_noise_rao_blackwell,
        update_rao_blackwell,
        initial=initial_rao_blackwell,
        rejuvenate=spread_rao_blackwell,
        per_particle=("P",),
    )
    unrolled: ClassVar[tuple[str, ...]] = ("sampled",)
    ensemble_size: int = 100
    sampled: Any = (0,)

    def __post_init__(self):
        super().__post_init__()
        indices = indices_of("sampled", self.sampled, self.model.t)
        if not indices:
            raise ValueError("sampled must be a list of indices, at least one, but got none")
        object.__setattr__(self, "sampled", indices)

    @property
    def spread_states(self) -> int:
        """How many states the kernel spreads."""
        return len(self.sampled)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Parameters of the page and of resampling; `kernel` is the squared width of the kernel."""
        parameters = super().parameters
        return {
            **parameters,
            "kernel": parameters["width"] ** 2,
            "flags": [i in self.sampled for i in range(self.model.t)],
        }

    def sample(self, belief: Belief) -> np.ndarray:
        """A state (n, N) drawn from each particle's N(x_j, P_j), and the row of log weights."""
        n, t, size = self.model.n, self.model.t, self.ensemble_size
        values, vectors = np.linalg.eigh(self.particle_covariances(belief))
        draws = np.zeros(padded(t * size, GROUP))
        fill_normals(draws, t * size, belief.step, FILTER_PROPOSAL, *belief.key)
        e = np.sqrt(np.maximum(values, 0.0)) * draws[: t * size].reshape(size, t)
        drawn = np.array(move(belief.members[:n], np.einsum("jab,jb->aj", vectors, e), self.model.turns))
        return np.concatenate([drawn, belief.members[n : n + 1]])

    def particle_covariances(self, belief: Belief) -> np.ndarray:
        """The covariances P_j (N, n, n) of the particles of a belief, with rotations (N, t, t)."""
        t, size = self.model.t, self.ensemble_size
        lower = np.tril(belief.members[self.model.n + 1 :].reshape(t, t, size).transpose(2, 0, 1))
        return lower + np.tril(lower, -1).transpose(0, 2, 1)
