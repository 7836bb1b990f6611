"""What every bow thruster env, single or in number, offers to filters."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from thruster_env.plant import Plant

if TYPE_CHECKING:
    from plants.state_space import StateSpaceModel
    from thruster_env.rendering import Overlay


class ModelledEnv:
    """An env with a `plant`, of which it offers the model."""

    plant: Plant

    def state_space_model(self, **changes) -> StateSpaceModel:
        """The model of the env's plant, exact unless changed; changes are those of `model.model_of_plant`.

        Raises ValueError that states the rule and the value.
        """
        from thruster_env.model import MODEL_ARGUMENTS, model_of_plant

        unknown = sorted(set(changes) - set(MODEL_ARGUMENTS))
        if unknown:
            rule = f"arguments of a bow thruster's model must be among {', '.join(MODEL_ARGUMENTS)}"
            raise ValueError(f"{rule}, but got {', '.join(map(repr, unknown))}")
        return model_of_plant(self.plant, **changes)

    def overlay(self, label: str, model: StateSpaceModel, mean: np.ndarray, cov: np.ndarray) -> Overlay:
        """What a rendered thruster shows of a belief beside the truth."""
        from thruster_env.model import overlay_of

        return overlay_of(label, model, mean, cov)

    def check_tuned_for(self, tuned_for: Mapping | None, file: str) -> None:
        """Raise ValueError if a tuned file is for another plant than the env's; warn where it is for other noise.

        A file that does not tell (None) is not compared.
        """
        from thruster_env.plant_data import check_same_plant

        if tuned_for is not None:
            others = check_same_plant(tuned_for, self.plant, file)
            if others:
                warnings.warn(f"{file} was tuned for {', '.join(others)}", stacklevel=5)
