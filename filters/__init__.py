"""Kalman-type filters: as values with `init`, `predict`, `update`, over batches, and as Gymnasium wrappers."""

from filters.affine import affine_model, linearize
from filters.batch import Estimates, run
from filters.belief import Belief, Innovation
from filters.ensemble import EnsembleKalmanFilter
from filters.extended import ExtendedKalmanFilter
from filters.kalman import KalmanFilter
from filters.model import StateSpaceModel
from filters.registry import FILTERS, make_filter
from filters.thruster import thruster_model
from filters.wrapper import EstimateState

__all__ = [
    "FILTERS",
    "Belief",
    "EnsembleKalmanFilter",
    "EstimateState",
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
