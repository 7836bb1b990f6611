"""`differentiable-enkf`: an ensemble Kalman filter that learns its noise by gradients through all its steps."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

import filters
from filters.learned.estimator import LearnedEstimator, Track
from filters.learned.networks import compressed, starting_at_zero
from filters.registry import make_filter
from filters.tensors.filter import TensorBelief


class TrackedBelief(TensorBelief):
    """A belief of an ensemble that can leave its derivatives behind."""

    def detach(self) -> TrackedBelief:
        """The same belief, detached from its derivatives."""
        extras = {name: tensor.detach() for name, tensor in self.extras.items()}
        return self._replace(mean=self.mean.detach(), cov=self.cov.detach(), extras=extras)


class DifferentiableEnsembleFilter(LearnedEstimator):
    """The stochastic EnKF with the model's f and h, whose Q and R are factors of networks on those of the model.

        Q_k = D Q D,  D = diag(exp(a + N(x, u)));   R_k = E R E,  E = diag(exp(b + M(v)))

    x are the states' means, u the inputs, v the innovation at the mean; a and b are constants, N and M two layers
    that begin at zero. The loss is the log density of the true states, differentiated through all members and
    steps, with random numbers that follow from the key.

    Sources: Chen, Sanz-Alonso and Willett (2022), "Autodifferentiable ensemble Kalman filters", SIAM J. Math. Data
    Sci. 4(2); Kloss, Martius and Bohg (2021), "How to train your differentiable filter", Autonomous Robots 45
    (noise that depends on state and measurement).
    """

    kind: ClassVar[str] = "differentiable-enkf"
    has_covariance: ClassVar[bool] = True
    gaussian_likelihood: ClassVar[bool] = True
    options: ClassVar[dict[str, int]] = {"ensemble_size": 30, "width": 32}

    process_noise_cov: Tensor
    measurement_noise_cov: Tensor

    def build(self) -> None:
        """Make the layers of the noise, so wide, for an ensemble of this size."""
        model, ensemble_size, width = self.model, *self.chosen.values()
        ensemble, equations = make_filter("enkf", model, ensemble_size=ensemble_size), self.equations
        self.tensors = filters.torch(ensemble, transition=equations.transition, observe=equations.observe)
        self.of_state, self.of_measurement = (
            nn.Sequential(nn.Linear(size, width), nn.Tanh(), starting_at_zero(nn.Linear(width, factors)))
            for size, factors in ((model.n + model.inputs, model.n), (model.m, model.m))
        )
        self.register_buffer("process_noise_cov", torch.tensor(model.process_noise_cov))
        self.register_buffer("measurement_noise_cov", torch.tensor(model.measurement_noise_cov))

    def begin(self, keys: np.ndarray, z: Tensor) -> Track:
        """The prior's members, updated with the first measurements."""
        tensors = self.tensors.replace(process_noise_cov=self.process_noise_cov)
        return self._updated(tensors.init(len(z), keys), z)

    def advance(self, track: Track, u: Tensor, z: Tensor) -> Track:
        """The members a step later, updated with the measurements."""
        x, centred = (track.mean - self.scale_state_mean) / self.scale_state, u - self.scale_input_mean
        factors = self.of_state(torch.cat([compressed(x), compressed(centred / self.scale_input)], -1))
        tensors = self.tensors.replace(process_noise_cov=_times(self.process_noise_cov, factors))
        return self._updated(tensors.predict(track.memory[0], u), z)

    def _updated(self, belief: TensorBelief, z: Tensor) -> Track:
        equations, present = self.equations, ~torch.isnan(z)
        innovation = equations.of_measurement(z - equations.measured(belief.mean))
        innovation = torch.where(present, innovation / self.scale_innovation, 0.0)
        factors = self.of_measurement(compressed(innovation))
        tensors = self.tensors.replace(measurement_noise_cov=_times(self.measurement_noise_cov, factors))
        belief, updated = tensors.update(belief, z)
        return Track(belief.mean, belief.cov, updated.value, updated.cov, (TrackedBelief(*belief),))


def _times(cov: Tensor, factors: Tensor) -> Tensor:
    """D cov D with D = diag(exp(factors)), for factors (B, size)."""
    root = torch.exp(factors)
    return root[..., :, None] * cov * root[..., None, :]
