"""`kalmannet` and `recursive-kalmannet`: filters whose gain a network learns."""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus

from filters.learned.estimator import LearnedEstimator, Track
from filters.learned.networks import HIDDEN, GainNetwork, compressed

MOST = 16  # states or measurements: weights grow with the fourth power, to sixteen million here


class Correction(NamedTuple):
    """A correction of predictions x~: the track after it, and its terms.

    Attributes:
        track: means, innovations and memory.
        gain: K (B, n, m).
        features: the network's inputs.
        lost: trajectories (B, 1) that restarted from the prior.
    """

    track: Track
    gain: Tensor
    features: tuple[Tensor, ...]
    lost: Tensor


class KalmanNet(LearnedEstimator):
    """A filter with the model's f and h, and a network in place of the gain that follows from Q and R.

        x~ = f(x', u),  v = z - h(x~),  x = x~ + K v
        K = K_0 + D_x N(z - z', v, x' - x'', x' - x~') D_v^-1

    where ' is the step before, D are the sizes of errors and innovations, K_0 is the mean gain of the filter
    that training starts from, and N the network (`GainNetwork`).

    Two things differ from the paper: inputs are divided by their sizes, where the paper divides each vector by its
    length, which leaves only the sign of a single channel; and N begins at zero, so that the gain begins at K_0.

    Source: Revach et al. (2022), "KalmanNet: Neural Network Aided Kalman Filtering for Partially Known Dynamics",
    IEEE Transactions on Signal Processing 70, eq. 7 to 9 and features F1 to F4.
    """

    kind: ClassVar[str] = "kalmannet"

    def build(self) -> None:
        """Make the network of the gain."""
        n, m = self.model.n, self.model.m
        if max(n, m) > MOST:
            rule = f"{self.kind} must have a model of at most {MOST} states and measurements"
            raise ValueError(f"{rule}, but got {n} and {m}")
        self.gain = GainNetwork(n, m, n * m)

    def begin(self, keys: np.ndarray, z: Tensor) -> Track:
        """The prior's mean, corrected by the first measurements."""
        return self._first(z).track

    def advance(self, track: Track, u: Tensor, z: Tensor) -> Track:
        """The predictions, corrected by the measurements."""
        return self._next(track, u, z).track

    def _first(self, z: Tensor) -> Correction:
        mean = self.prior_mean.expand(len(z), -1)
        still, before = torch.zeros_like(mean), torch.full_like(z, torch.nan)
        return self._corrected(mean, (still, still, before, *self.gain.start(len(z))), z, mean)

    def _next(self, track: Track, u: Tensor, z: Tensor) -> Correction:
        return self._corrected(self.equations.moved(track.mean, u), track.memory, z, track.mean)

    def _corrected(self, predicted: Tensor, memory: tuple, z: Tensor, last: Tensor) -> Correction:
        """The correction of predictions x~ (B, n) by measurements (B, m), after the last estimates (B, n)."""
        equations, (change, corrected, before) = self.equations, memory[:3]
        present = ~torch.isnan(z)
        innovation = _known(equations.of_measurement(z - equations.measured(predicted)), present)
        measured = _known(equations.of_measurement(z - before), present & ~torch.isnan(before))
        of_z = torch.cat([measured / self.scale_measured, innovation / self.scale_innovation], -1)
        features = tuple(map(compressed, (change / self.scale_moved, corrected / self.scale_corrected, of_z)))
        output, hidden = self.gain(memory[3 : 3 + HIDDEN], *features)
        learned = self.scale_error[:, None] * output.unflatten(-1, self.scale_gain.shape)
        gain = self.scale_gain + learned / self.scale_innovation
        correction = (gain @ innovation[..., None])[..., 0]
        mean = equations.of_state(predicted + correction)
        lost = ~torch.isfinite(mean).all(-1, keepdim=True)
        mean = torch.where(lost, self.prior_mean, mean)
        changes = (
            torch.where(lost, 0.0, tensor) for tensor in (equations.of_state(mean - last), correction, *hidden)
        )
        change, corrected, *hidden = changes
        track = Track(mean, None, innovation, None, (change, corrected, z, *hidden))
        return Correction(track, gain, features, lost)


class RecursiveKalmanNet(KalmanNet):
    """A KalmanNet with a covariance in Joseph's form, whose noise term is the output of a second network.

        P = (I - K H) F P' F' (I - K H)' + B B'

    F and H are the model's Jacobians, without derivatives along the estimate; B is the lower triangular output of
    the second network, in the place of the root of (I - K H) Q (I - K H)' + K R K'. The loss is the log density of
    the true states.

    Source: Mortada, Falcon, Kahil, Clavaud and Michel (2025), "Recursive KalmanNet: Deep Learning-Augmented Kalman
    Filtering for State Estimation with Consistent Uncertainty Quantification", EUSIPCO, arXiv:2506.11639.
    """

    kind: ClassVar[str] = "recursive-kalmannet"
    has_covariance: ClassVar[bool] = True

    def build(self) -> None:
        """Make the networks of the gain and of the noise."""
        super().build()
        n = self.model.n
        self.root = GainNetwork(n, self.model.m, n * (n + 1) // 2)

    def begin(self, keys: np.ndarray, z: Tensor) -> Track:
        """The prior, corrected by the first measurements."""
        hidden, batch = self.root.start(len(z)), (len(z), -1)
        mean, cov = self.prior_mean.expand(*batch), self.prior_cov.expand(*batch, -1)
        return self._with_cov(self._first(z), mean, cov, hidden)

    def advance(self, track: Track, u: Tensor, z: Tensor) -> Track:
        """The predictions, corrected by the measurements."""
        assert track.cov is not None
        with torch.no_grad():
            predicted, jacobian = self.equations.moved_with_jacobian(track.mean, u)
        cov = jacobian @ track.cov @ jacobian.mT
        return self._with_cov(self._next(track, u, z), predicted, cov, track.memory[-HIDDEN:])

    def _with_cov(self, correction: Correction, predicted: Tensor, cov: Tensor, hidden: tuple) -> Track:
        with torch.no_grad():
            slopes = self.equations.measured_with_jacobian(predicted)[1]
        output, hidden = self.root(hidden, *correction.features)
        n = self.model.n
        rows, columns = torch.tril_indices(n, n)
        on_diagonal = rows == columns
        root = torch.zeros_like(cov)
        root[..., rows, columns] = self.scale_error[rows] * torch.where(on_diagonal, softplus(output), output)
        present = ~torch.isnan(correction.track.memory[2])
        factor = torch.eye(n, dtype=cov.dtype) - correction.gain @ torch.where(present[..., None], slopes, 0.0)
        cov = factor @ cov @ factor.mT + root @ root.mT
        cov = torch.where(correction.lost[..., None], self.prior_cov, 0.5 * (cov + cov.mT))
        return correction.track._replace(cov=cov, memory=(*correction.track.memory, *hidden))


def _known(difference: Tensor, present: Tensor) -> Tensor:
    """A difference of measurements, with value and derivatives of zero where one is missing."""
    return torch.where(present, torch.where(present, difference, 0.0), 0.0)
