"""The interface of a plant's env or vector env for filters: its model, and checks of tuned files."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from thruster_env.model.state_space import StateSpaceModel


class ModelledEnv:
    """An env with a `plant`, which offers the plant's model to filters.

    Attributes:
        plant_name: the plant's name in messages.
    """

    plant_name: ClassVar[str] = "a plant"
    plant: Any

    def model_maker(self) -> Callable[..., StateSpaceModel]:
        """The function that makes a model of the plant and of changes by name."""
        raise NotImplementedError

    def tuned_differences(self, tuned_for: Mapping, file: str) -> list[str]:
        """Minor differences between a tuned file's plant and the env's; ValueError for essential ones.

        None by default: states, inputs, sensors and dt are compared for every model.
        """
        return []

    def state_space_model(self, **changes) -> StateSpaceModel:
        """The model of the env's plant, exact unless changed; changes are arguments of its `model_maker`.

        Raises ValueError if an argument is wrong; the message states the rule and the value.
        """
        make = self.model_maker()
        known = list(inspect.signature(make).parameters)[1:]
        unknown = sorted(set(changes) - set(known))
        if unknown:
            rule = f"arguments of {self.plant_name}'s model must be among {', '.join(known)}"
            raise ValueError(f"{rule}, but got {', '.join(map(repr, unknown))}")
        return make(self.plant, **changes)

    def check_tuned_for(self, tuned_for: Mapping | None, file: str) -> None:
        """Raise ValueError if a tuned file is for another plant than the env's; warn if it is for other noise.

        A file without this entry (None) is not compared.
        """
        if tuned_for is not None:
            others = self.tuned_differences(tuned_for, file)
            if others:
                warnings.warn(f"{file} was tuned for {', '.join(others)}", stacklevel=5)
