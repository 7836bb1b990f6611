"""Filters by name, with the parameters that each has beside its model."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

from filters.adaptive import RobustExtendedKalmanFilter, SageHusaFilter, VariationalBayesFilter
from filters.baselines import Inversion, LowPass, OpenLoop
from filters.ensembles.iterated import IteratedEnsembleKalmanFilter
from filters.ensembles.square_root import (
    EnsembleTransformFilter,
    FiniteSizeEnsembleFilter,
    LocalEnsembleTransformFilter,
    RankHistogramFilter,
    SerialSquareRootFilter,
)
from filters.ensembles.stochastic import DeterministicEnsembleKalmanFilter, EnsembleKalmanFilter
from filters.estimators.foreign import (
    ForeignFilter,
    estimator_named,
    is_estimator,
    is_filter_class,
    is_foreign,
    label_of,
)
from filters.filter import Filter
from filters.gaussian.extended import (
    ExtendedKalmanFilter,
    FadingMemoryFilter,
    HInfinityFilter,
    IteratedExtendedKalmanFilter,
    SchmidtKalmanFilter,
)
from filters.gaussian.kalman import KalmanFilter, SteadyStateKalmanFilter
from filters.gaussian.mixtures import FuzzyKalmanFilter, GaussianSumFilter
from filters.gaussian.multiple_models import InteractingMultipleModelFilter, MultipleModelAdaptiveEstimator
from filters.gaussian.sigma_points import CubatureKalmanFilter, UnscentedKalmanFilter
from filters.horizon.moving_horizon import MovingHorizonFilter
from filters.particles.particle import AuxiliaryParticleFilter, ParticleFilter, RaoBlackwellisedParticleFilter
from thruster_env.core.checks import one_of, short_repr
from thruster_env.core.modules import error_line
from thruster_env.logs.log import AnyStepModel
from thruster_env.model.state_space import StateSpaceModel

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


def as_filter(estimator: Any, label: str, model: StateSpaceModel, numbers: dict) -> Filter:
    """An estimator in the place of a filter.

    Args:
        estimator: an estimator; or a function or class that makes one, or a `Filter`, from a model and `numbers`.
        label: its name in tables, if it does not name itself.
        model: passed to the function; it names states, inputs and measurements and says which are angles.
        numbers: further arguments of the function.

    Raises:
        ValueError: if it neither is an estimator nor makes one.
    """
    if not is_estimator(estimator):
        estimator = _made(estimator, label, model, numbers)
    elif numbers:
        rule = "numbers must come with a function that makes an estimator"
        raise ValueError(f"{rule}, but {label!r} is one already, and got {', '.join(numbers)}")
    if isinstance(estimator, Filter):
        return estimator
    return ForeignFilter(model=model, estimator=estimator, label=label)


def _made(make, label: str, model: StateSpaceModel, numbers: dict) -> Any:
    what = f"{'filter' if is_filter_class(make) else 'estimator'} {label!r}"
    if not callable(make):
        raise ValueError(f"{what} must be an estimator, or make one of a model, but it is {short_repr(make)}")
    try:
        result = make(model=model, **numbers) if is_filter_class(make) else make(model, **numbers)
    except Exception as error:
        wanted = ", ".join(["a model", *numbers])
        raise ValueError(f"{what} must be made of {wanted}, but raised {error_line(error)}") from error
    if not isinstance(result, Filter) and not is_estimator(result):
        rule = f"{what} must make an object with reset(key, z) and step(u, z), or run(keys, inputs, measurements)"
        raise ValueError(f"{rule}, but made {short_repr(result)}")
    return result


class FilterType(NamedTuple):
    """A filter's name resolved: what makes the filter, and the parameters that it has beside its model."""

    name: Any  # as `filter_type` got it
    filter_class: type[Filter]  # the filter's class; `ForeignFilter` of an estimator
    estimator: Any = None  # the user's object that the name stands for; None for a filter of `FILTERS`

    @property
    def is_foreign(self) -> bool:
        """Whether it is a user's estimator or filter."""
        return self.estimator is not None

    @property
    def is_estimator(self) -> bool:
        """Whether it is a user's estimator, not a class of filters."""
        return self.filter_class is ForeignFilter

    @property
    def label(self) -> str:
        """Its name in tables."""
        return label_of(self.name)

    @property
    def has_covariance(self) -> bool:
        """Whether it has a covariance, and so Q and R."""
        return self.filter_class.has_covariance

    @property
    def has_ensemble(self) -> bool:
        """Whether it has an ensemble whose size can be chosen."""
        return "ensemble_size" in self.numbers

    @property
    def declared(self) -> tuple:
        """The tunable parameters that an estimator declares, `Parameter`s; none by default."""
        parameters = getattr(self.estimator, "parameters", ()) if self.is_estimator else ()
        is_list = isinstance(parameters, list | tuple)  # of a network in torch it is a method
        return tuple(parameters) if is_list else ()

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of its parameters beside its model, or of those that an estimator declares as tunable."""
        if self.is_estimator:
            return tuple(parameter.name for parameter in self.declared)
        return tuple(field.name for field in dataclasses.fields(self.filter_class) if field.name != "model")

    def make(self, model: StateSpaceModel, **numbers) -> Filter:
        """The filter for a model; see `make_filter`."""
        if self.is_foreign:
            return as_filter(self.estimator, self.label, model, numbers)
        for number in numbers:
            one_of(f"a number of filter {self.name!r}", number, self.numbers)
        if isinstance(model, AnyStepModel) and not self.filter_class.any_step:
            rule = "a filter on a log's own stamps must know steps of any length"
            raise ValueError(f"{rule}, but {self.name!r} does not: 'ekf' does")
        return self.filter_class(model=model, **numbers)


def filter_type(name) -> FilterType:
    """The filter type of a name.

    Args:
        name: of a filter in `FILTERS`; "module:object" or a trained estimator's file; or an estimator itself, or a
            function that makes one from a model.

    Raises:
        ValueError: for an unknown name.
    """
    if not is_foreign(name):
        return FilterType(name, FILTERS[one_of("filter", name, tuple(FILTERS), LISTED)])
    estimator = estimator_named(name)
    return FilterType(name, estimator if is_filter_class(estimator) else ForeignFilter, estimator)


def make_filter(name, model: StateSpaceModel, **numbers) -> Filter:
    """Make a filter by name, for a model, with its own parameters.

    Args:
        name: of a filter in `FILTERS`, such as "ekf"; or a user's estimator or filter: an object, a function, or
            class, of a model (and of `numbers`) that makes one, "module:object" for any of these, or the file of a
            trained estimator.
        model: the model that the filter assumes, with Q, R and the prior; an estimator takes the names and angles
            of states, inputs and measurements from it.
        **numbers: parameters of the filter beside its model, such as `ensemble_size`; defaults where not given.

    Raises:
        ValueError: for an unknown name or parameter, a value that the filter does not accept, or an object that is
            no estimator.
    """
    if isinstance(model, str):
        way = "filters.named.model_named(text)(dt=...) makes one of a text, and a fit of tuning.fit has .filter"
        raise ValueError(f"model must be a model, but got {short_repr(model)}: {way}")
    return filter_type(name).make(model, **numbers)
