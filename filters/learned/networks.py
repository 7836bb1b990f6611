"""Recurrent networks of learned estimators."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from filters.learned.estimator import LearnedEstimator, Track

INPUT_WIDTH, OUTPUT_WIDTH = 5, 40  # factors on sizes of inputs and outputs, those of Revach et al. (2022)
HIDDEN = 3  # recurrent layers of a `GainNetwork`


def compressed(x: Tensor) -> Tensor:
    """Features whose large values, such as an outlier's, enter by their logarithm: asinh(x)."""
    return torch.asinh(x)


def dense(size: int, width: int) -> nn.Sequential:
    """A layer with a rectified linear output."""
    return nn.Sequential(nn.Linear(size, width), nn.ReLU())


def starting_at_zero(layer: nn.Linear) -> nn.Linear:
    """The same layer, with weights and biases of zero: a network that begins by changing nothing."""
    nn.init.zeros_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


class GainNetwork(nn.Module):
    """Three recurrent layers in the places of Q, P and S, whose output is a vector for each step.

    The structure is that of a Kalman filter's covariances, each layer fed by what drives its covariance:

        q = GRU(moved);  p = GRU(q, corrected);  s = GRU(p, measured, innovation);  output = dense(p, s)

    and p goes back into the next step, after a correction by s and the output.

    Args:
        n: states.
        m: measurements.
        outputs: entries of the output, such as n m of a gain.

    Source: Revach et al. (2022), "KalmanNet", IEEE Transactions on Signal Processing 70, fig. 4 (architecture 2).
    """

    def __init__(self, n: int, m: int, outputs: int):
        super().__init__()
        states, channels = n * n, m * m
        self.of_moved, self.of_corrected = dense(n, INPUT_WIDTH * n), dense(n, INPUT_WIDTH * n)
        self.of_measured = dense(2 * m, 2 * INPUT_WIDTH * m)
        self.q = nn.GRUCell(INPUT_WIDTH * n, states)
        self.p = nn.GRUCell(states + INPUT_WIDTH * n, states)
        self.s = nn.GRUCell(channels + 2 * INPUT_WIDTH * m, channels)
        self.from_p = dense(states, channels)
        self.wide = dense(states + channels, OUTPUT_WIDTH * (states + channels))
        self.last = starting_at_zero(nn.Linear(OUTPUT_WIDTH * (states + channels), outputs))
        self.back = dense(channels + outputs, states)
        self.back_to_p = dense(2 * states, states)
        self.sizes = states, states, channels

    def start(self, batch: int) -> tuple[Tensor, ...]:
        """Hidden states of a batch at its first step."""
        return tuple(torch.zeros(batch, size, dtype=torch.float64) for size in self.sizes)

    def forward(
        self, hidden: tuple[Tensor, ...], change: Tensor, corrected: Tensor, measured: Tensor
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The output (B, outputs) and the next hidden states.

        Args:
            hidden: of the step before.
            change: of the estimate over the last step, (B, n).
            corrected: the last correction of an estimate, (B, n).
            measured: change of the measurement and innovation, (B, 2 m).
        """
        q, p, s = hidden
        q = self.q(self.of_moved(change), q)
        p = self.p(torch.cat([q, self.of_corrected(corrected)], -1), p)
        s = self.s(torch.cat([self.from_p(p), self.of_measured(measured)], -1), s)
        output = self.last(self.wide(torch.cat([p, s], -1)))
        back = self.back(torch.cat([s, output], -1))
        return output, (q, self.back_to_p(torch.cat([p, back], -1)), s)


# `gru`: a recurrent network that estimates without a model.


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
        present = ~torch.isnan(z)
        measured = torch.where(present, (z - self.scale_measurement_mean) / self.scale_measurement, 0.0)
        features = torch.cat([(u - self.scale_input_mean) / self.scale_input, measured, present.double()], -1)
        hidden = self.cell(features, hidden)
        standardised = self.last(torch.cat([hidden, features], -1))
        mean = self.equations.of_state(self.scale_state_mean + self.scale_state * standardised)
        return Track(mean, None, None, None, (hidden,))
