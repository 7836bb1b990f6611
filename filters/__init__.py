"""Kalman-type filters: as values with `init`, `predict`, `update`, over batches, and as Gymnasium wrappers."""

from filters.affine import affine_model, linearize
from filters.augmented import Unknown, augmented_model
from filters.auxiliary import AuxiliaryParticleFilter
from filters.baselines import Inversion, LowPass, OpenLoop
from filters.batch import Estimates, run
from filters.belief import Belief, Innovation
from filters.cubature import CubatureKalmanFilter
from filters.deterministic import DeterministicEnsembleKalmanFilter
from filters.ensemble import EnsembleKalmanFilter
from filters.envs import register_filtered_envs
from filters.extended import ExtendedKalmanFilter
from filters.fuzzy import FuzzyKalmanFilter
from filters.gaussian_sum import GaussianSumFilter
from filters.iterated import IteratedExtendedKalmanFilter
from filters.iterated_ensemble import IteratedEnsembleKalmanFilter
from filters.kalman import KalmanFilter
from filters.model import StateSpaceModel
from filters.particle import ParticleFilter
from filters.registry import FILTERS, make_filter
from filters.robust import RobustExtendedKalmanFilter
from filters.sage_husa import SageHusaFilter
from filters.serial import SerialSquareRootFilter
from filters.smoothers import Smoothed, smooth
from filters.steady_state import SteadyStateKalmanFilter
from filters.thruster import thruster_model
from filters.transform import EnsembleTransformFilter
from filters.unscented import UnscentedKalmanFilter
from filters.variational import VariationalBayesFilter
from filters.vector_wrapper import EstimateStates
from filters.wrapper import EstimateState

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
    "FuzzyKalmanFilter",
    "GaussianSumFilter",
    "Innovation",
    "Inversion",
    "IteratedEnsembleKalmanFilter",
    "IteratedExtendedKalmanFilter",
    "KalmanFilter",
    "LowPass",
    "OpenLoop",
    "ParticleFilter",
    "RobustExtendedKalmanFilter",
    "SageHusaFilter",
    "SerialSquareRootFilter",
    "Smoothed",
    "StateSpaceModel",
    "SteadyStateKalmanFilter",
    "UnscentedKalmanFilter",
    "Unknown",
    "VariationalBayesFilter",
    "affine_model",
    "augmented_model",
    "linearize",
    "make_filter",
    "run",
    "smooth",
    "thruster_model",
]

register_filtered_envs()
