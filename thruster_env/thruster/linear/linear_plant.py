"""The published linear systems as plants, where the Kalman filter is optimal."""

from __future__ import annotations

import numpy as np

from thruster_env.core.arguments import takes_arguments_of
from thruster_env.core.checks import one_of
from thruster_env.thruster.linear.analysis import LinearModel
from thruster_env.thruster.linear.published import PUBLISHED
from thruster_env.thruster.plant import Plant, make_plant

PUBLISHED_NOISE = 0.5  # variance of each state a step, and of the measurement, in the published runs


@takes_arguments_of(make_plant, leaving_out=["preset", "uncertainty", "substeps"])
def make_linear_plant(system: str = "tunnel", **plant_arguments) -> Plant:
    """Make a plant that follows a published linear system instead of the equations of motion.

    Args:
        system: "tunnel" or "open_bladed"; see `published`.
        **plant_arguments: those of `make_plant`, without preset, uncertainty and substeps; measurement_noise_cov
            is the published 0.5 for every channel if None.

    Raises:
        ValueError: if an argument is wrong; the message states the rule and the value.
    """
    model = PUBLISHED[one_of("system", system, tuple(PUBLISHED))]
    plant = make_plant("tunnel", substeps=1, **plant_arguments)
    if "current" in plant.channels:
        raise ValueError("the linear systems must be measured by other channels than the current, which they lack")
    dynamics = LinearModel(*(np.array(matrix) for matrix in (model.a, model.b, model.c)))
    plant = plant._replace(linear=dynamics)
    if plant_arguments["measurement_noise_cov"] is None:
        return plant._replace(measurement_noise_cov=PUBLISHED_NOISE * np.eye(len(plant.channels)))
    return plant
