"""What every env and vector env of the vehicle offers to filters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from thruster_env.auv.plant import Plant
from thruster_env.env.modelled import ModelledEnv
from thruster_env.model.split import Split, split

if TYPE_CHECKING:
    from thruster_env.auv.rendering import Overlay
    from thruster_env.model.state_space import StateSpaceModel


class ModelledVehicle(ModelledEnv):
    """An env with a `plant` that offers its model to filters; changes are those of `model.model_of_plant`.

    Unless `states` says otherwise, that is the smaller of "motion" (8 states) and "navigation" (12) that predicts
    all channels: of the default sensors, which have compass and depth, "navigation".
    """

    plant_name = "a vehicle"
    plant: Plant

    def model_maker(self) -> Callable[..., StateSpaceModel]:
        """`model.model_of_plant`."""
        from thruster_env.auv.model import model_of_plant

        return model_of_plant

    def state_space_model(self, **changes) -> StateSpaceModel:
        """See `thruster_env.env.modelled`; for "velocities" roll and pitch are as measured, else level."""
        attitude = "measured" if {"phi", "theta"} <= set(self.plant.channels) else "level"
        return super().state_space_model(**{"attitude": attitude} | changes)

    def measured_inputs(self, model: StateSpaceModel) -> Split | None:
        """Which channels are a model's inputs beside the action, by symbol; None where there are none."""
        return split(model, len(self.plant.inputs), self.plant.channels)

    def tuned_differences(self, tuned_for: Mapping, file: str) -> list[str]:
        """See `plant_data.check_same_plant`."""
        from thruster_env.auv.plant_data import check_same_plant

        return check_same_plant(tuned_for, self.plant, file)

    def overlay(self, label: str, model: StateSpaceModel, mean: np.ndarray, cov: np.ndarray) -> Overlay:
        """The belief that a rendered vehicle shows beside the truth: the states it has, by their symbols."""
        from thruster_env.auv.rendering import Overlay

        names = {state.symbol: i for i, state in enumerate(model.states)}
        std = np.sqrt(np.maximum(np.diag(cov), 0.0)).tolist()
        shown = {"x": "x", "y": "y", "depth": "z", "phi": "phi", "theta": "theta", "psi": "psi", "u": "u"}
        known = {name: names[symbol] for name, symbol in shown.items() if symbol in names}
        values = {name: float(mean[i]) for name, i in known.items()}
        spreads = {f"{name}_std": std[i] for name, i in known.items() if f"{name}_std" in Overlay._fields}
        return Overlay(label, **values, **spreads)
