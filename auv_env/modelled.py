"""What every env of the vehicle, single or in number, offers to filters."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from auv_env.plant import Plant
from plants.modelled import ModelledEnv

if TYPE_CHECKING:
    from plants.state_space import StateSpaceModel


class ModelledVehicle(ModelledEnv):
    """An env with a `plant`, of which it offers the model; changes are those of `model.model_of_plant`.

    Unless `states` says otherwise, that is the smaller of "motion" (8 states) and "navigation" (12) that predicts
    all channels: of the default sensors, which have compass and depth, "navigation".
    """

    plant_name = "a vehicle"
    plant: Plant

    def model_maker(self) -> Callable[..., StateSpaceModel]:
        """`model.model_of_plant`."""
        from auv_env.model import model_of_plant

        return model_of_plant
