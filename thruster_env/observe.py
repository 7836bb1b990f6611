"""The true state (motor speed [rad/s], flow velocity [m/s]) in a thruster env's observation."""

from plants.observe import ObserveState, ObserveStateVector

__all__ = ["ObserveState", "ObserveStateVector"]
