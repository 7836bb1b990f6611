"""The bootstrap particle filter: a weighted sample of states, whose distribution may have any shape."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

from filters.baselines.baselines import places_of
from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, own_place, row_access
from filters.particles.motion import add_noise, clear_noise, drawer, ensemble_motion
from filters.particles.proposal import proposal_works
from filters.particles.regularisation import constants_spreader, cov_spreader, kernel_spreader
from filters.particles.weighted import ResampledFilter, anything_measured, particle_parts
from filters.particles.weights import read_weights, systematic_resampler
from thruster_env.numerics.checks import one_of
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.streams import FILTER_MEASUREMENT, FILTER_PROPOSAL, uniform_block
from thruster_env.numerics.tuples import column_reader, matrix_reader
from thruster_env.plants.layout import number_places
from thruster_env.plants.shape import Functions, Shape

PROPOSALS, RESAMPLINGS = ("prior", "optimal"), ("systematic", "gaussian")


class Kind(NamedTuple):
    """What a particle filter does that needs code of its own."""

    regularised: bool = False
    gaussian: bool = False  # it draws particles of a Gaussian, where others resample
    optimal: bool = False  # its proposal
    smoothed: tuple[int, ...] = ()  # states that the kernel spreads alone


@lru_cache(maxsize=64)
def particle_kernels(functions: Functions, shape: Shape, kind: Kind) -> Kernels:
    """Kernels of a particle filter for a model's functions and shape.

    The table's rows: n of particles, one of log weights, n of noise if the proposal is optimal, one of weights,
    scratch. Behind the ESS the row then has the Q of that noise: a later update may meet another one.
    """
    n, m, observe = shape.n, shape.m, functions.observe
    kept = n + 1 + kind.optimal * n
    places, noise, weights = memory_places(n, m), n + 1, kept
    scratch, logarithms, regularised = weights + 1, n, kind.regularised
    size_place, step_place, key_0, key_1 = places.extras, places.step, places.key_0, places.key_1
    likelihood_place, threshold_place = places.log_likelihood, own_place(shape) + 1
    motion, parts = ensemble_motion(functions.transition, shape), particle_parts(observe, shape, weights)
    draw_prior, move = motion.start, motion.predict
    set_equal, expect, normal, distance, level, weigh, summarise = parts
    resample = systematic_resampler(n, weights, scratch)
    read_r, predicted = matrix_reader(m, m, number_places(n, m).r), column_reader(m, scratch)
    (read_mean, read_cov), root = row_access(shape)[0], size_place + 1 + kind.optimal * n * n
    spread = constants_spreader(shape, kind.smoothed, root) if kind.smoothed else kernel_spreader(shape, root)
    spread_by = cov_spreader(shape, root)

    @inlined
    def start(memory, numbers, size):
        draw_prior(memory, numbers, size)
        set_equal(memory, size)

    @inlined
    def choose(memory, numbers, size):
        row, table, _ = memory
        read_weights(table, logarithms, weights, size)
        place, _, _, _ = uniform_block(0, row[step_place], FILTER_MEASUREMENT, row[key_0], row[key_1])
        resample(table, size, place)
        if regularised:
            spread(memory, read_cov(row), numbers, size)  # no particle moved since that was their covariance

    @inlined
    def draw_gaussian(memory, numbers, size):
        row, table, _ = memory
        mean = read_mean(row)
        for i in range(n):
            for j in range(table.shape[1]):
                table[i, j] = mean[i]
        spread_by(memory, read_cov(row), 1.0)

    renew = draw_gaussian if kind.gaussian else choose

    @inlined
    def predict(memory, u, numbers, size):
        row, table, _ = memory
        if row[size_place] < numbers[threshold_place] * size:
            renew(memory, numbers, size)
            set_equal(memory, size)
        move(memory, u, numbers, size)

    @inlined
    def update(memory, z, numbers, size):
        row, table, _ = memory
        expect(memory, z, numbers, size)
        row[likelihood_place] = 0.0
        if anything_measured(z):
            sensor = normal(z, read_r(numbers))
            for j in range(table.shape[1]):
                table[logarithms, j] -= distance(predicted(table, j), sensor)
            row[likelihood_place] = weigh(memory, size) + level(sensor)
        else:
            summarise(memory, size)

    of_root = n * n if regularised or kind.gaussian else 0
    rows = scratch + max(m, n + 2)
    if not kind.optimal:
        return Kernels(n, m, rows, n, start, predict, update, summarise, 1, kept - n, of_root)

    noise_cov, log_weight, source = size_place + 1, scratch + m, number_places(n, m)
    works, rows_of_works, length = proposal_works(functions, shape, noise, log_weight, noise_cov)
    condition, draw, q_place, q_root_place = works["update"], drawer(n, m), source.q, source.q_root

    @inlined
    def forget_noise(memory):
        row, table, _ = memory
        for i in range(n * n):
            row[noise_cov + i] = 0.0
        clear_noise(table, noise, n)

    @inlined
    def start_without_noise(memory, numbers, size):
        start(memory, numbers, size)
        forget_noise(memory)

    @inlined
    def predict_with_noise(memory, u, numbers, size):
        row, table, draws = memory
        predict(memory, u, numbers, size)
        forget_noise(memory)
        add_noise(table, noise, n, draws, numbers, q_root_place)  # of the very draws that moved the particles
        for i in range(n * n):
            row[noise_cov + i] = numbers[q_place + i]

    @inlined
    def propose(memory, z, numbers, size):
        row, table, draws = memory
        expect(memory, z, numbers, size)
        row[likelihood_place] = 0.0
        if anything_measured(z):
            draw(draws, m * table.shape[1], row, FILTER_PROPOSAL)
            condition(row, z, numbers, table, draws, size)
            for j in range(table.shape[1]):
                table[logarithms, j] += table[log_weight, j]
            row[likelihood_place] = weigh(memory, size)
            forget_noise(memory)
        else:
            summarise(memory, size)

    return Kernels(
        *(n, m, max(rows, rows_of_works), max(n, m), start_without_noise, predict_with_noise, propose, summarise),
        extras=1 + n * n,
        extra_kept_rows=kept - n,
        scratch=of_root + length,
    )


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
    stays: x_j = m + (1 - b^2)^(1/2) (x_j - m) + b e_j,  b = c h for as many states. For constants that are states,
    of `augmented_model` without a walk: resampling alone would soon leave one value of them.

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

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        model, gaussian = self.kernel_model, self.resampling == "gaussian"
        kind = Kind(self.regularisation > 0.0, gaussian, self.proposal == "optimal", self.smoothed)
        return particle_kernels(model.functions, model.shape, kind)
