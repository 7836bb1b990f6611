"""The auxiliary particle filter: particles are chosen by how well their prediction fits the measurement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.algebra.blocks import zeros
from filters.algebra.densities import log_density
from filters.algebra.members import on_branch
from filters.algebra.operations import only, present, uncorrelated, wrap
from filters.algebra.samples import weighted_square, weights
from filters.ensembles.steps import advance
from filters.pages.page_filter import Page
from filters.particles import weighted
from filters.particles.renewal import spread
from filters.particles.weighted import WeightedFilter, expect, fit


def start(model, w):
    """A particle of the prior, without noise."""
    return weighted.start(model, w), {"noise": zeros(model.Q, len(w))}


def settle(model, x, w):
    """The end of a step, of which the noise is kept."""
    noise = model.Q_root @ w
    return on_branch(x + noise, model.state_angles), {"noise": noise}


def foresee(model, x, log_w, z):
    """A particle without its noise, log N(z; h(mu), R + V), and innovation and S of all with noise."""
    seen, mu = present(z), x - model.kept["noise"]
    y, v, S = expect(model, x, log_w, z)
    without = only(seen, model.h(mu))
    V = weighted_square(wrap(y - without, model.measurement_angles), weights(log_w))
    rest = only(seen, wrap(z - without, model.measurement_angles))
    return mu, log_density(rest, V + uncorrelated(seen, model.R), seen), v, S


def update(model, x, log_w, z, e):
    """The measurement z: particles mu that were chosen, with the noise of the places to which they went.

    `log_w` is the logarithm of the mean of all lambda, over N(z; h(mu), R + V).
    """
    x = x + model.kept["noise"]  # which was not resampled
    return x, log_w + fit(model, only(present(z), model.h(x)), z), {"noise": zeros(model.Q, len(x))}


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

    V, the covariance that the noise causes in the measurement, keeps the weights w_j bounded where the noise is
    large: with V = 0, the textbook choice, a few particles that mu had ruled out would take all the weight.

    The log-likelihood is log L; innovation, S and restarts are the bootstrap filter's. `Belief.members` is
    (2 n + 1, N): particles, log weights, noise. `Belief.extras` holds the effective sample size.

    Attributes are those of `WeightedFilter`, c its regularisation and h as in `ParticleFilter`.

    Source: Pitt, Shephard (1999), "Filtering via simulation: auxiliary particle filters", section 3, where the
    first stage's density is free; the likelihood: Pitt (2002), "Smooth particle filters for likelihood evaluation
    and maximisation".
    """

    name: ClassVar[str] = "apf"
    page: ClassVar[Page] = Page(
        advance, settle, update, start=start, renew=spread, foresee=foresee, of_each=("noise",)
    )
