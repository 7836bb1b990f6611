"""The bootstrap particle filter: a weighted sample of states, whose distribution may have any shape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from filters.baselines.baselines import places_of
from filters.engine.belief import Kernels
from filters.ensembles.steps import advance, settle
from filters.pages.page_filter import Page
from filters.particles.kernels import particle_kernels
from filters.particles.proposal import OPTIMAL
from filters.particles.renewal import draw, smooth, spread
from filters.particles.weighted import ResampledFilter, expect, fit, start
from thruster_env.core.checks import one_of

PROPOSALS, RESAMPLINGS = ("prior", "optimal"), ("systematic", "gaussian")


def update(model, x, log_w, z, e):
    """The measurement z; channels that are NaN are missing."""
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

    That is the bootstrap filter. With the optimal proposal an update draws each particle again, given z:

        v_j = z - h(mu_j),  S_j = H_j Q H_j' + R,  K_j = Q H_j' S_j^-1,  H_j = dh/dx at mu_j
        noise_j += K_j (v_j - H_j noise_j - r_j),  r_j ~ N(0, R),  x_j = mu_j + noise_j
        w_j = w_j N(v_j; 0, S_j) N(z; h(x_j), R)/N(v_j; H_j noise_j, R), divided by their sum L

    Where h is linear x is drawn from p(x | x_before, z), and the weight is p(z | x_before), which does not depend
    on the draw: fewer particles are lost where sensors are accurate beside Q. Elsewhere the proposal is that of an
    extended filter per particle, and the weight corrects what the tangent neglects. It needs the noise of the
    prediction: directly after the prior or another update, an update is the bootstrap filter's.

    If `resampling` is "gaussian", particles are drawn again from N(mean, cov), where others are resampled: the
    Gaussian particle filter, if the threshold is 1.

    If states are `smoothed`, the kernel spreads these alone, and draws them together, so that their covariance
    stays: x_j = m + a (x_j - m) + b e_j,  b = c h for as many states,  a = (1 - b^2)^(1/2). For constants that are
    states, of `augmented_model` without a walk: resampling alone would soon leave one value of them.

    The log-likelihood is log L. The innovation is z less the weighted mean of h(x_j), and its covariance S the
    weighted covariance of h(x_j) plus R. Resampling waits for the next prediction, so that a belief has the
    moments of the weighted particles, without the noise of a draw. Where two or three particles have all the
    weight, the covariance is nearly singular and the NEES (normalised estimation error squared) far too large: a
    sign of too few particles. If no particle has any weight, because the measurement is impossible under the
    model, the belief restarts from the prior, which `divergences` counts.

    `Belief.members` is (n + 1, N), its last row the log weights; with the optimal proposal n rows of noise follow.
    `Belief.extras` holds the ESS, and then the Q of that noise.

    Attributes:
        proposal: "prior", or "optimal" to draw particles again where z is.
        resampling: "systematic", or "gaussian" to draw particles from N(mean, cov) instead.
        smoothed: indices of states that are constants, which the kernel alone spreads; -1 is the last. They need a
            regularisation, of some 1.

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
    page: ClassVar[Page] = Page(advance, settle, update, start=start, renew=spread)
    proposal: str = "prior"
    resampling: str = "systematic"
    smoothed: Any = ()

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        one_of("proposal", self.proposal, PROPOSALS)
        one_of("resampling", self.resampling, RESAMPLINGS)
        object.__setattr__(self, "smoothed", places_of("smoothed", self.smoothed, self.model.n))
        if self.regularisation and self.resampling == "gaussian":
            raise ValueError("a filter that draws from a Gaussian must have no regularisation, but got one")

    @property
    def spread_states(self) -> int:
        """How many states the kernel spreads."""
        return len(self.smoothed) or self.model.n

    @property
    def parameters(self) -> Mapping[str, Any]:
        """What the page and resampling read; of smoothed states the `width` is b, and `drawn` is 1 - a."""
        given = super().parameters
        if not self.smoothed:
            return given
        width = min(given["width"], 1.0)
        flags = [float(i in self.smoothed) for i in range(self.model.n)]
        return {**given, "width": width, "drawn": 1.0 - (1.0 - width**2) ** 0.5, "smoothed": flags}

    @property
    def written_page(self) -> Page:
        """The page of the choices."""
        page = super().written_page
        if self.proposal == "optimal":
            page = OPTIMAL._replace(renew=page.renew, own=page.own)
        if self.resampling == "gaussian":
            return page._replace(renew=draw)
        return page._replace(renew=smooth) if self.smoothed and self.regularisation else page

    def kernels(self) -> Kernels:
        """Kernels of the page for the model's functions; see `Filter.kernels`."""
        model, resample = self.kernel_model, self.resampling == "systematic"
        return particle_kernels(self.written_page, model.functions, model.shape, resample)
