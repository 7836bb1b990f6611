"""What every bow thruster env and vector env offers to filters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from thruster_env.env.modelled import ModelledEnv
from thruster_env.thruster.plant import Plant

if TYPE_CHECKING:
    from thruster_env.model.state_space import StateSpaceModel
    from thruster_env.thruster.rendering import Overlay


class ModelledThruster(ModelledEnv):
    """An env with a `plant` that offers its model to filters; changes are those of `model.model_of_plant`."""

    plant_name = "a bow thruster"
    plant: Plant

    def model_maker(self) -> Callable[..., StateSpaceModel]:
        """`model.model_of_plant`."""
        from thruster_env.thruster.model import model_of_plant

        return model_of_plant

    def tuned_differences(self, tuned_for: Mapping, file: str) -> list[str]:
        """See `plant_data.check_same_plant`."""
        from thruster_env.thruster.plant_data import check_same_plant

        return check_same_plant(tuned_for, self.plant, file)

    def overlay(self, label: str, model: StateSpaceModel, mean: np.ndarray, cov: np.ndarray) -> Overlay:
        """The belief that a rendered thruster shows beside the truth."""
        from thruster_env.thruster.model import overlay_of

        return overlay_of(label, model, mean, cov)
