"""An autonomous underwater vehicle: equations of motion, parameters, sensors, and its model for filters."""

from auv_env.parameters import VehicleParameters
from auv_env.presets import PRESETS
from numerics.compiled import may_be_inlined

may_be_inlined(__name__, "plants")

__all__ = ["PRESETS", "VehicleParameters"]
