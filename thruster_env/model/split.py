"""Channels of an env that a model takes as inputs, such as an attitude from an AHRS, and as measurements."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from thruster_env.model.state_space import StateSpaceModel


class Split(NamedTuple):
    """Indices of an env's channels that are inputs of a model, and of those that are measurements.

    Attributes:
        inputs: channels of the model's last inputs, in their order.
        measurements: channels of its measurements.
        channels: number of the env's channels.
    """

    inputs: tuple[int, ...]
    measurements: tuple[int, ...]
    channels: int


def split(model: StateSpaceModel, actions: int, channels: Sequence[str]) -> Split | None:
    """Find a model's inputs beyond the first `actions`, and its measurements, among channels by their symbols.

    None if there are no such inputs, or if one of them is no channel.
    """
    inputs = [quantity.symbol for quantity in model.input_quantities[actions:]]
    measurements = [quantity.symbol for quantity in model.measurements]
    if not inputs or not set(inputs + measurements) <= set(channels):
        return None
    return Split(tuple(map(channels.index, inputs)), tuple(map(channels.index, measurements)), len(channels))
