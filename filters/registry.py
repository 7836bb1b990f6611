"""Filters by name, with the parameters that each has beside its model."""

from __future__ import annotations

import dataclasses

from filters.adaptive.robust import RobustExtendedKalmanFilter
from filters.adaptive.sage_husa import SageHusaFilter
from filters.adaptive.variational import VariationalBayesFilter
from filters.baselines.baselines import Inversion, LowPass, OpenLoop
from filters.ensembles.deterministic import DeterministicEnsembleKalmanFilter
from filters.ensembles.finite_size import FiniteSizeEnsembleFilter
from filters.ensembles.iterated import IteratedEnsembleKalmanFilter
from filters.ensembles.rank_histogram import RankHistogramFilter
from filters.ensembles.serial import SerialSquareRootFilter
from filters.ensembles.stochastic import EnsembleKalmanFilter
from filters.ensembles.transform import EnsembleTransformFilter, LocalEnsembleTransformFilter
from filters.estimators.find import foreign_filter, is_foreign, own_filter, parameters_of
from filters.estimators.foreign import ForeignFilter
from filters.filter import Filter
from filters.gaussian.cubature import CubatureKalmanFilter
from filters.gaussian.extended import ExtendedKalmanFilter
from filters.gaussian.fading import FadingMemoryFilter
from filters.gaussian.fuzzy import FuzzyKalmanFilter
from filters.gaussian.gaussian_sum import GaussianSumFilter
from filters.gaussian.h_infinity import HInfinityFilter
from filters.gaussian.iterated import IteratedExtendedKalmanFilter
from filters.gaussian.kalman import KalmanFilter
from filters.gaussian.multiple_models import InteractingMultipleModelFilter, MultipleModelAdaptiveEstimator
from filters.gaussian.schmidt import SchmidtKalmanFilter
from filters.gaussian.steady_state import SteadyStateKalmanFilter
from filters.gaussian.unscented import UnscentedKalmanFilter
from filters.horizon.moving_horizon import MovingHorizonFilter
from filters.particles.auxiliary import AuxiliaryParticleFilter
from filters.particles.particle import ParticleFilter
from filters.particles.rao_blackwell import RaoBlackwellisedParticleFilter
from thruster_env.numerics.checks import one_of
from thruster_env.plants.state_space import StateSpaceModel
from thruster_env.plants.steps import AnyStepModel

LISTED = "thruster filters"  # the command that lists all
FILTERS: dict[str, type[Filter]] = {
    kind.name: kind
    for kind in (
        KalmanFilter,
        SteadyStateKalmanFilter,
        ExtendedKalmanFilter,
        IteratedExtendedKalmanFilter,
        UnscentedKalmanFilter,
        CubatureKalmanFilter,
        MovingHorizonFilter,
        FadingMemoryFilter,
        HInfinityFilter,
        SchmidtKalmanFilter,
        EnsembleKalmanFilter,
        EnsembleTransformFilter,
        LocalEnsembleTransformFilter,
        SerialSquareRootFilter,
        DeterministicEnsembleKalmanFilter,
        IteratedEnsembleKalmanFilter,
        FiniteSizeEnsembleFilter,
        RankHistogramFilter,
        ParticleFilter,
        AuxiliaryParticleFilter,
        RaoBlackwellisedParticleFilter,
        GaussianSumFilter,
        InteractingMultipleModelFilter,
        MultipleModelAdaptiveEstimator,
        FuzzyKalmanFilter,
        SageHusaFilter,
        VariationalBayesFilter,
        RobustExtendedKalmanFilter,
        OpenLoop,
        LowPass,
        Inversion,
    )
}


def filter_class(name: str) -> type[Filter]:
    """The class of a filter by name, or by "module:class"; `ForeignFilter` for estimators.

    Raises:
        ValueError: for an unknown name.
    """
    if is_foreign(name):
        return own_filter(name) or ForeignFilter
    return FILTERS[one_of("filter", name, tuple(FILTERS), LISTED)]


def tunable_numbers(name: str) -> tuple[str, ...]:
    """Names of a filter's parameters beside its model, or of those that an estimator declares as tunable."""
    if is_foreign(name) and own_filter(name) is None:
        return tuple(one.name for one in parameters_of(name))
    return tuple(field.name for field in dataclasses.fields(filter_class(name)) if field.name != "model")


def make_filter(name: str, model: StateSpaceModel, **numbers) -> Filter:
    """Make a filter by name, for a model, with its own parameters.

    Args:
        name: of a filter in `FILTERS`, such as "ekf"; or an estimator or a filter of your own, as
            `filters.estimators.find.foreign_filter` takes it, such as "module:class".
        model: the model that the filter assumes, with Q, R and the prior.
        **numbers: parameters of the filter beside its model, such as `ensemble_size`; defaults where not given.

    Raises:
        ValueError: for an unknown name or parameter, or a value that the filter does not accept.
    """
    if is_foreign(name):
        return foreign_filter(name, model, **numbers)
    known = tunable_numbers(name)
    for number in numbers:
        one_of(f"a number of filter {name!r}", number, known)
    if isinstance(model, AnyStepModel) and not filter_class(name).any_step:
        raise ValueError(f"a filter on a log's own stamps must know steps of any length, but {name!r} does not")
    return filter_class(name)(model=model, **numbers)
