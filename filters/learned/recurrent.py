"""`gru`: a recurrent network that estimates without a model."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from filters.learned.estimator import LearnedEstimator, Track
from filters.learned.networks import starting_at_zero


class GatedRecurrentUnit(LearnedEstimator):
    """A recurrent network from inputs and measurements to the states, without a model and without a covariance.

        g = (u, z, which of z are there),  h = GRU(g; h'),  x = mean + D (A h + B g)

    Inputs and measurements are standardised. It begins with the mean of the true states, and is the baseline that
    shows what the model contributes.

    Source: Cho et al. (2014), "Learning phrase representations using RNN encoder-decoder", EMNLP.
    """

    kind: ClassVar[str] = "gru"
    needs_model: ClassVar[bool] = False
    options: ClassVar[dict[str, int]] = {"width": 64}

    def build(self) -> None:
        """Make the layers, with so many hidden states as `width` says."""
        width = self.chosen["width"]
        size = self.model.inputs + 2 * self.model.m
        self.cell = nn.GRUCell(size, width)
        self.last = starting_at_zero(nn.Linear(width + size, self.model.n))

    def begin(self, keys: np.ndarray, z: Tensor) -> Track:
        """The estimates at the first measurements, with inputs at their mean."""
        hidden = torch.zeros(len(z), self.cell.hidden_size, dtype=torch.float64)
        return self._moved(hidden, self.scale_input_mean.expand(len(z), -1), z)

    def advance(self, track: Track, u: Tensor, z: Tensor) -> Track:
        """The estimates a step later."""
        return self._moved(track.memory[0], u, z)

    def _moved(self, hidden: Tensor, u: Tensor, z: Tensor) -> Track:
        seen = ~torch.isnan(z)
        measured = torch.where(seen, (z - self.scale_measurement_mean) / self.scale_measurement, 0.0)
        given = torch.cat([(u - self.scale_input_mean) / self.scale_input, measured, seen.double()], -1)
        hidden = self.cell(given, hidden)
        standardised = self.last(torch.cat([hidden, given], -1))
        mean = self.equations.of_state(self.scale_state_mean + self.scale_state * standardised)
        return Track(mean, None, None, None, (hidden,))
