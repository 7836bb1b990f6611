"""Kalman-type filters: as values with `init`, `predict`, `update`, over batches, and as Gymnasium wrappers."""

from filters.affine import affine_model, linearize
from filters.batch import Estimates, run
from filters.belief import Belief, Innovation
from filters.ensemble import EnsembleKalmanFilter
from filters.envs import register_filtered_envs
from filters.extended import ExtendedKalmanFilter
from filters.kalman import KalmanFilter
from filters.model import StateSpaceModel
from filters.registry import FILTERS, make_filter
from filters.thruster import thruster_model
from filters.vector_wrapper import EstimateStates
from filters.wrapper import EstimateState

__all__ = [
    "FILTERS",
    "Belief",
    "EnsembleKalmanFilter",
    "EstimateState",
    "EstimateStates",
    "Estimates",
    "ExtendedKalmanFilter",
    "Innovation",
    "KalmanFilter",
    "StateSpaceModel",
    "affine_model",
    "linearize",
    "make_filter",
    "run",
    "thruster_model",
]

register_filtered_envs()
