"""Kalman-type filters: as values with `init`, `predict`, `update`, over batches, and as Gymnasium wrappers."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from filters import wrappers  # noqa: F401 - registers ids with a filter, once Gymnasium is imported

if TYPE_CHECKING:
    from filters.adaptive import RobustExtendedKalmanFilter, SageHusaFilter, VariationalBayesFilter
    from filters.augmented import Unknown, augmented_model, transformed_model
    from filters.baselines import Inversion, LowPass, OpenLoop
    from filters.engine.batch import Estimates
    from filters.engine.belief import Belief, Innovation
    from filters.ensembles.iterated import IteratedEnsembleKalmanFilter
    from filters.ensembles.square_root import (
        EnsembleTransformFilter,
        FiniteSizeEnsembleFilter,
        LocalEnsembleTransformFilter,
        RankHistogramFilter,
        SerialSquareRootFilter,
    )
    from filters.ensembles.stochastic import DeterministicEnsembleKalmanFilter, EnsembleKalmanFilter
    from filters.estimators.libraries import (
        from_control,
        from_filterpy,
        from_pykalman,
        from_statsmodels,
        to_filterpy,
    )
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
    from filters.registry import FILTERS, make_filter
    from filters.runs import run, smooth
    from filters.smoothers import Smoothed, SmoothedModes, smooth_modes
    from filters.starts import Restarts, RestartWarning, restarts_of
    from filters.tensors import torch
    from filters.wrappers.envs import EstimateState, EstimateStates
    from thruster_env.model.affine import affine_model, linearize
    from thruster_env.model.state_space import StateSpaceModel

__all__ = [
    "FILTERS",
    "AuxiliaryParticleFilter",
    "Belief",
    "CubatureKalmanFilter",
    "DeterministicEnsembleKalmanFilter",
    "EnsembleKalmanFilter",
    "EnsembleTransformFilter",
    "EstimateState",
    "EstimateStates",
    "Estimates",
    "ExtendedKalmanFilter",
    "FadingMemoryFilter",
    "FiniteSizeEnsembleFilter",
    "FuzzyKalmanFilter",
    "GaussianSumFilter",
    "Innovation",
    "HInfinityFilter",
    "InteractingMultipleModelFilter",
    "Inversion",
    "IteratedEnsembleKalmanFilter",
    "IteratedExtendedKalmanFilter",
    "KalmanFilter",
    "LocalEnsembleTransformFilter",
    "LowPass",
    "MovingHorizonFilter",
    "MultipleModelAdaptiveEstimator",
    "OpenLoop",
    "ParticleFilter",
    "RankHistogramFilter",
    "RaoBlackwellisedParticleFilter",
    "RobustExtendedKalmanFilter",
    "RestartWarning",
    "Restarts",
    "SageHusaFilter",
    "SchmidtKalmanFilter",
    "SerialSquareRootFilter",
    "Smoothed",
    "SmoothedModes",
    "StateSpaceModel",
    "SteadyStateKalmanFilter",
    "UnscentedKalmanFilter",
    "Unknown",
    "VariationalBayesFilter",
    "affine_model",
    "augmented_model",
    "from_control",
    "from_filterpy",
    "from_pykalman",
    "from_statsmodels",
    "linearize",
    "make_filter",
    "restarts_of",
    "run",
    "smooth",
    "smooth_modes",
    "to_filterpy",
    "torch",
    "transformed_model",
]


MODULES = {
    "filters.adaptive": ("RobustExtendedKalmanFilter", "SageHusaFilter", "VariationalBayesFilter"),
    "filters.augmented": ("Unknown", "augmented_model", "transformed_model"),
    "filters.baselines": ("Inversion", "LowPass", "OpenLoop"),
    "filters.engine.batch": ("Estimates",),
    "filters.engine.belief": ("Belief", "Innovation"),
    "filters.ensembles.iterated": ("IteratedEnsembleKalmanFilter",),
    "filters.ensembles.square_root": (
        "EnsembleTransformFilter",
        "FiniteSizeEnsembleFilter",
        "LocalEnsembleTransformFilter",
        "RankHistogramFilter",
        "SerialSquareRootFilter",
    ),
    "filters.ensembles.stochastic": ("DeterministicEnsembleKalmanFilter", "EnsembleKalmanFilter"),
    "filters.estimators.libraries": (
        "from_control",
        "from_filterpy",
        "from_pykalman",
        "from_statsmodels",
        "to_filterpy",
    ),
    "filters.gaussian.extended": (
        "ExtendedKalmanFilter",
        "FadingMemoryFilter",
        "HInfinityFilter",
        "IteratedExtendedKalmanFilter",
        "SchmidtKalmanFilter",
    ),
    "filters.gaussian.kalman": ("KalmanFilter", "SteadyStateKalmanFilter"),
    "filters.gaussian.mixtures": ("FuzzyKalmanFilter", "GaussianSumFilter"),
    "filters.gaussian.multiple_models": ("InteractingMultipleModelFilter", "MultipleModelAdaptiveEstimator"),
    "filters.gaussian.sigma_points": ("CubatureKalmanFilter", "UnscentedKalmanFilter"),
    "filters.horizon.moving_horizon": ("MovingHorizonFilter",),
    "filters.particles.particle": ("AuxiliaryParticleFilter", "ParticleFilter", "RaoBlackwellisedParticleFilter"),
    "filters.registry": ("FILTERS", "make_filter"),
    "filters.runs": ("run", "smooth"),
    "filters.smoothers": ("Smoothed", "SmoothedModes", "smooth_modes"),
    "filters.starts": ("Restarts", "RestartWarning", "restarts_of"),
    "filters.tensors": ("torch",),
    "filters.wrappers.envs": ("EstimateState", "EstimateStates"),
    "thruster_env.model.affine": ("affine_model", "linearize"),
    "thruster_env.model.state_space": ("StateSpaceModel",),
    "thruster_env.thruster.model": ("thruster_model",),  # for one release
}
HOMES = {name: module for module, names in MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    """A filter or a function, whose module is imported when it is asked for: `import filters` alone is light."""
    if name in HOMES:
        value = globals()[name] = getattr(import_module(HOMES[name]), name)
        return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Names of the filters and functions."""
    return sorted({*__all__, *globals()})
