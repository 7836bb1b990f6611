"""Learned estimators by name, and their recurrent networks.

`kalmannet` and `recursive-kalmannet` learn a filter's gain, `gru` estimates without a model, and
`differentiable-enkf` learns an ensemble Kalman filter's noise by gradients through all its steps.
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

import filters
from filters.learned import check_file
from filters.learned.estimator import LearnedEstimator, Track
from filters.registry import make_filter
from filters.tensors.filter import TensorBelief
from thruster_env.core.checks import one_of
from thruster_env.core.files import write_whole
from thruster_env.model.state_space import StateSpaceModel

INPUT_WIDTH, OUTPUT_WIDTH = 5, 40  # factors on sizes of inputs and outputs, those of Revach et al. (2022)
HIDDEN = 3  # recurrent layers of a `GainNetwork`
MOST = 16  # states or measurements: weights grow with the fourth power, to sixteen million here


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


# Trained estimators as files: numbers and their description, in the format safetensors.
#
# Nothing in a file names code to run.


LEARNED = {
    kind.kind: kind for kind in (KalmanNet, RecursiveKalmanNet, GatedRecurrentUnit, DifferentiableEnsembleFilter)
}
FORMAT = 1
MOST_NAMED = 5  # differing constants in an error
DESCRIPTION = "estimator"  # the entry of a file's metadata that describes it


class TrainedEstimator:
    """A trained estimator as it lies in a file; called with a model it makes the estimator.

    Attributes:
        path: of the file.
        name: of the estimator, such as "kalmannet".
        about: what the file says: `kind`, `options`, `model` (a digest of its equations), `sizes`, `quantities`
            (names and units, which older files lack), `training`.
    """

    def __init__(self, path: str | Path):
        from safetensors import SafetensorError, safe_open

        self.path = str(path)
        try:
            with safe_open(self.path, framework="pt") as file:
                self.about = json.loads((file.metadata() or {})[DESCRIPTION])
                self._numbers = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
            wrong = [name for name, tensor in self._numbers.items() if not tensor.isfinite().all()]
            if wrong:
                raise ValueError(f"{', '.join(wrong)} must be finite, but have NaN or infinity")
            if self.about["format"] != FORMAT:
                raise ValueError(f"its format is not {FORMAT}")
            kind, self._options = str(self.about["kind"]), dict(self.about["options"])
            self._digest, self._quantities = self.about["model"], self.about.get("quantities")
            self.training = dict(self.about.get("training") or {})
            constants = dict(self.about.get("constants") or {})  # older files have none
            self._constants = {str(key): float(value) for key, value in constants.items()}
            if self._quantities is not None:
                self._quantities = [
                    [tuple(map(str, quantity)) for quantity in entries] for entries in self._quantities
                ]
        except (SafetensorError, KeyError, TypeError, ValueError, AttributeError) as error:
            rule = "an estimator's file must be one of `thruster train-estimator`"
            raise ValueError(f"{rule}, but {self.path} is not: {error}") from None
        self.name = one_of("a trained estimator", kind, tuple(LEARNED))

    def __call__(self, model: StateSpaceModel) -> LearnedEstimator:
        """The estimator for a model; ValueError for another model than that of the training."""
        kind = LEARNED[self.name]
        self._check(model, kind.needs_model)
        estimator = kind(model, **self._options)
        try:
            estimator.load_state_dict(self._numbers)
        except RuntimeError as error:
            reason = "; ".join(line.strip() for line in str(error).splitlines()[1:]) or str(error)
            raise ValueError(f"{self.path} must have the numbers of a {self.name}, but: {reason}") from None
        return estimator

    def _check(self, model: StateSpaceModel, needs_model: bool) -> None:
        """Raise ValueError for another model; without a model's equations for other names and units of quantities.

        Default names, such as x_1 without a unit, or missing names do not identify a plant: then the equations
        must agree.
        """
        quantities = quantities_of(model)
        if model.digest == self._digest:
            return
        if not needs_model and quantities == self._quantities and not _are_unnamed(model):
            return
        rule = f"{self.path} must be used with the model that it was trained with"
        if self._quantities is not None and quantities != self._quantities:
            both = zip(self._quantities, quantities, strict=True)
            expected, actual = next((_listed(stored), _listed(other)) for stored, other in both if stored != other)
            raise ValueError(f"{rule}, {expected}, but got {actual}")
        then, now = self._constants, constants_of(model)
        differing = [
            f"{name} {then[name]:.4g} (here {value:.4g})"
            for name, value in now.items()
            if name in then and then[name] != value
        ]
        more = len(differing) - MOST_NAMED
        differing = differing[:MOST_NAMED] + ([f"{more} more"] if more > 0 else [])
        problem = self.training.get("problem")
        of_problem = "" if problem is None else f", that of {problem}"
        raise ValueError(f"{rule}{of_problem}, but that had {', '.join(differing) or 'other equations'}")


def quantities_of(model: StateSpaceModel) -> list[list[tuple[str, str]]]:
    """Symbols and units of states, inputs and measurements."""
    return [[(quantity.symbol, quantity.unit) for quantity in quantities] for quantities in model.quantities]


def constants_of(model: StateSpaceModel) -> dict[str, float]:
    """The named constants of a model that are numbers, which tell one preset from another."""
    named: dict = getattr(model.constants, "_asdict", dict)()
    return {name: float(constant) for name, constant in named.items() if isinstance(constant, int | float)}


def _are_unnamed(model: StateSpaceModel) -> bool:
    """Whether all quantities have the symbols that they get of themselves, and no unit."""
    pairs = zip("xuz", model.quantities, strict=True)
    return quantities_of(model) == [
        [(f"{letter}_{i + 1}", "") for i in range(len(quantities))] for letter, quantities in pairs
    ]


def _listed(quantities: list[tuple[str, str]]) -> str:
    return ", ".join(f"{symbol} [{unit}]" if unit else symbol for symbol, unit in quantities) or "none"


def sizes_of(model: StateSpaceModel) -> list[int]:
    """Numbers of states, inputs and measurements."""
    return [model.n, model.inputs, model.m]


def write_estimator(path: str | Path, estimator: LearnedEstimator, training: dict[str, Any]) -> None:
    """Write a trained estimator to a file, whole or not at all.

    Args:
        path: of the file, which ends in .safetensors.
        estimator: the estimator.
        training: what is to be known of its training, as data for JSON.
    """
    from safetensors.torch import save

    about = {
        "format": FORMAT,
        "kind": estimator.kind,
        "options": estimator.chosen,
        "model": estimator.model.digest,
        "sizes": sizes_of(estimator.model),
        "quantities": quantities_of(estimator.model),
        "constants": constants_of(estimator.model),
        "training": training,
    }
    numbers = {name: tensor.contiguous() for name, tensor in estimator.state_dict().items()}
    write_whole(path, save(numbers, {DESCRIPTION: json.dumps(about)}))


@lru_cache(maxsize=32)
def _read(path: str, changed: int) -> TrainedEstimator:
    return TrainedEstimator(path)


def read(path: str | Path) -> TrainedEstimator:
    """The trained estimator of a file; read again only after a change."""
    check_file(path)
    return _read(str(path), Path(path).stat().st_mtime_ns)
