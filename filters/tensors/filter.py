"""`TensorFilter`: a filter on batches of tensors, its results, and its compiled likelihood with a gradient."""

from __future__ import annotations

from collections.abc import Callable
from math import prod
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from filters.ensembles.ensemble import EnsembleFilter, check_page_is_all
from filters.filter import Filter, with_page
from filters.sensitivity import likelihood
from filters.tensors.equations import CompiledRecursion, Estimate, Numbers, OfGraph, Recursion, equation_of
from filters.tensors.stages import LOW, ROUNDS, WEYL, EnsembleStages, Stages, root, wrapped_where
from thruster_env.core.checks import as_floats, one_of, short_repr, switch
from thruster_env.core.sources import lower_pairs
from thruster_env.core.streams import filter_keys
from thruster_env.graphs.programs import Place

DIMENSIONS = {"process_noise_cov": 2, "measurement_noise_cov": 2, "prior_mean": 1, "prior_cov": 2, "constants": 1}
"""A filter's numbers, those of its model, and how many dimensions each has beside those of a batch."""
MADE = ("_model", "_own", "_stages", "_traced", "_programs")  # again of a copy
SYNCHRONOUS = {"cpu"}
"""Devices that answer at once whether a trajectory is lost; of others it is asked once a run, not in each step."""


class TensorBelief(NamedTuple):
    """The estimates of a batch at one time.

    Attributes:
        mean: of the states, (..., n), in the units of the model.
        cov: covariances of the errors, (..., n, n).
        divergences: restarts from the prior, (...,).
        extras: the page's extras by name, such as an estimate of R; of an ensemble its `members` (..., n, N).
        key: (..., 2) whole numbers, which determine an ensemble's random numbers together with `step`.
        step: steps predicted.
    """

    mean: Tensor
    cov: Tensor
    divergences: Tensor
    extras: dict[str, Tensor]
    key: np.ndarray = np.zeros(2)
    step: int = 0

    @property
    def anomalies(self) -> Tensor:
        """The distances (..., n, N) of an ensemble's members from their mean."""
        members = self.extras["members"]
        return members - members.mean(-1, keepdim=True)


class TensorInnovation(NamedTuple):
    """Innovations of an update, as `Innovation` has them: (..., m), (..., m, m) and (...,)."""

    value: Tensor
    cov: Tensor
    log_likelihood: Tensor


class TensorEstimates(NamedTuple):
    """A filter's output over a batch of trajectories; as `Estimates` has it, but tensors.

    Attributes:
        means: (..., K + 1, n).
        covs: (..., K + 1, n, n).
        innovations: (..., K + 1, m); zero in missing channels.
        innovation_covs: S, (..., K + 1, m, m).
        log_likelihoods: (..., K + 1).
        divergences: restarts from the prior, (...,).
    """

    means: Tensor
    covs: Tensor
    innovations: Tensor
    innovation_covs: Tensor
    log_likelihoods: Tensor
    divergences: Tensor


def compiled_likelihood(filter_: Filter, inputs: Any, measurements: Any, q: Tensor, r: Tensor) -> Tensor:
    """Log-likelihoods (B,) of trajectories, with the gradient of `filters.sensitivity` along Q and R.

    Args:
        filter_: a filter with a page.
        inputs: (B, K, p); None for a model without.
        measurements: (B, K + 1, m), NaN where missing.
        q: Q, (n, n).
        r: R, (m, m).
    """
    z = np.asarray(torch.as_tensor(as_numbers(measurements)).detach().cpu(), dtype=np.float64)
    if inputs is None:
        inputs = np.zeros((len(z), z.shape[1] - 1, 0))
    u = np.asarray(torch.as_tensor(as_numbers(inputs)).detach().cpu(), dtype=np.float64)
    return _Likelihood.apply(filter_, u, z, q, r)


def as_numbers(value: Any) -> Any:
    """A tensor, or a list of such, as it is; else an array of floats, NaN where something is missing."""
    if isinstance(value, Tensor) or isinstance(value, (list, tuple)) and any(isinstance(a, Tensor) for a in value):
        return value
    return np.ascontiguousarray(as_floats(value))


class _Likelihood(torch.autograd.Function):
    """The recursion, and its gradient along the entries of Q and R on and below the diagonal."""

    @staticmethod
    def forward(ctx, filter_, u, z, q, r):
        noise = [cov.detach().cpu().double().numpy() for cov in (q, r)]
        model = filter_.model.replace(process_noise_cov=noise[0], measurement_noise_cov=noise[1])
        counts = [
            len(lower_pairs(len(cov))) * moves for cov, moves in zip(noise, ctx.needs_input_grad[3:], strict=True)
        ]
        q_slopes, r_slopes = (np.zeros((sum(counts), *cov.shape)) for cov in noise)
        q_slopes[: counts[0]], r_slopes[counts[0] :] = (
            _units(len(cov))[:k] for cov, k in zip(noise, counts, strict=True)
        )
        result = likelihood(model, u, z, q_slopes, r_slopes, filter=filter_)
        ctx.save_for_backward(q, r, q.new_tensor(result.gradients))
        ctx.counts = counts
        return q.new_tensor(result.values)

    @staticmethod
    @once_differentiable
    def backward(ctx, of_values):
        q, r, gradients = ctx.saved_tensors
        entries = (of_values @ gradients).split(ctx.counts)
        return None, None, None, *(_symmetric(slopes, like) for slopes, like in zip(entries, (q, r), strict=True))


def _units(size: int) -> np.ndarray:
    """Symmetric matrices (pairs, size, size) with ones at a pair of places, the directions of `lower_pairs`."""
    units = np.zeros((len(lower_pairs(size)), size, size))
    for unit, (i, j) in zip(units, lower_pairs(size), strict=True):
        unit[i, j] = unit[j, i] = 1.0
    return units


def _symmetric(entries: Tensor, like: Tensor) -> Tensor | None:
    """The gradient G with dL = <G, dS>, of slopes along pairs of places; None if there are none."""
    if not len(entries):
        return None
    matrix = torch.zeros_like(like)
    rows, columns = torch.tensor(lower_pairs(len(like)), device=like.device).T
    matrix[rows, columns] = entries
    return 0.5 * (matrix + matrix.mT)  # halves beside the diagonal, for which there are two places


def round_keys(key: np.ndarray, device: torch.device) -> Tensor:
    """The words of all rounds, (..., 10, 2), of keys (..., 2)."""
    words = np.asarray(key).astype(np.uint64).astype(np.int64)[..., None, :]
    return torch.as_tensor((words + np.outer(np.arange(ROUNDS), WEYL)) & LOW, device=device)


class TensorFilter:
    """A filter on batches of tensors, which torch differentiates; `filters.torch` makes one.

    Its estimates are those of `filters.run` to rounding: angles, substeps, missing channels, restarts and an
    ensemble's random numbers are the same. It has derivatives along every tensor: the attributes below, inputs,
    measurements, and parameters of its functions. Random numbers do not depend on these. A trajectory that
    restarts from the prior has estimates; its gradient is NaN.

    Attributes:
        process_noise_cov: Q (n, n), or one for each trajectory (..., n, n); of a step, as the model's.
        measurement_noise_cov: R (m, m) or (..., m, m).
        prior_mean: (n,) or (..., n).
        prior_cov: (n, n) or (..., n, n).
        constants: c (count,) or (..., count); the model's functions get it in the form that they have.

    The filter's own parameters, such as `inflation`, may be replaced by tensors () or (...), too.
    """

    process_noise_cov: Tensor
    measurement_noise_cov: Tensor
    prior_mean: Tensor
    prior_cov: Tensor
    constants: Tensor

    def __init__(
        self,
        filter_: Filter,
        *,
        transition: Callable | None = None,
        observe: Callable | None = None,
        transition_jacobian: Callable | None = None,
        observe_jacobian: Callable | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
        compiled: bool = False,
    ):
        """Make the filter for tensors.

        Args:
            filter_: a filter with a page, so no "gsf", "imm", "mmae", "mhe" or "fuzzy".
            transition: f(x, u, c) in place of the model's, a function of tuples of tensors (...,) that returns one
                for each state; it may contain a network. x, u and c are those of `StateSpaceModel`.
            observe: h(x, c), or h(x, u, c), in place of the model's.
            transition_jacobian: df/dx of such a transition, by rows; by `torch.func.jvp` if None.
            observe_jacobian: dh/dx of such a function.
            dtype: torch.float64, or torch.float32.
            device: of all tensors.
            compiled: whether `run` fuses a step's operations by `torch.compile`, once for each shape of the data.

        Raises:
            ValueError: for a filter without a page or with random rotations, another dtype, functions that are to
                replace those of an affine approximation, or that are to be compiled.
        """
        if dtype not in (torch.float64, torch.float32):
            raise ValueError(f"dtype must be torch.float64 or torch.float32, but got {dtype}")
        self.filter, self._user_functions = filter_, (transition, transition_jacobian, observe, observe_jacobian)
        self._changed: dict[str, Tensor] = {}
        self._compiled = switch("compiled", compiled)
        self._make()
        if self._compiled and not self._traced:
            raise ValueError("compiled=True must go with a model whose functions can be traced")
        if self._model is not filter_.model and any(self._user_functions):
            rule = "functions of tensors need a filter on the model itself"
            raise ValueError(f"{rule}, but got {filter_.name!r}, which uses an affine approximation")
        for name in DIMENSIONS:
            setattr(self, name, torch.as_tensor(getattr(self._model, name), dtype=dtype, device=device))

    def _make(self) -> None:
        paged = with_page(self.filter, "a filter on tensors")
        self._model, self._own = paged.kernel_model, paged.parameters
        shape, (f, by_f, h, by_h) = self._model.any_shape, self._model.functions
        transition, by_transition, observe, by_observe = self._user_functions
        f_equation = equation_of("transition", (f, by_f), (transition, by_transition), shape)
        h_equation = equation_of("observe", (h, by_h), (observe, by_observe), shape)
        self._traced = all(isinstance(equation, OfGraph) for equation in (f_equation, h_equation))
        self._programs: dict[Any, Any] = {}
        if isinstance(paged, EnsembleFilter):
            check_page_is_all(paged, "on tensors")
            self._stages: Stages = EnsembleStages(f_equation, h_equation, shape, paged.page_with())
        else:
            self._stages = Stages(f_equation, h_equation, shape, paged.written_page)

    def __getstate__(self) -> dict[str, Any]:
        """All but graphs, which are made again."""
        return {name: value for name, value in vars(self).items() if name not in MADE}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._make()

    def replace(self, **numbers: Any) -> Self:
        """The filter with other numbers, such as `process_noise_cov=Q`, along which it is differentiated.

        Raises:
            ValueError: for a name that is none of a filter's numbers, or a value whose shape does not fit.
        """
        replaced = object.__new__(type(self))
        vars(replaced).update(vars(self))
        own_names = tuple(name for name in self._own if hasattr(self.filter, name))
        for name, value in numbers.items():
            if one_of("a number of a filter", name, (*DIMENSIONS, *own_names)) in own_names:
                replaced._changed = {
                    **replaced._changed,
                    name: self._tensor(name, value, np.shape(self._own[name])),
                }
            else:
                before = getattr(self, name)
                setattr(replaced, name, self._tensor(name, value, before.shape[-DIMENSIONS[name] :]))
        return replaced

    def init(self, batch: int | tuple[int, ...] = (), key: Any = (0, 0)) -> TensorBelief:
        """The prior for a batch of trajectories.

        Args:
            batch: its size or its shape.
            key: two whole numbers, or (..., 2) for a batch, on which an ensemble's random numbers depend.
        """
        shape, key = (batch,) if isinstance(batch, int) else tuple(batch), _checked_key(key)
        if self.filter.size:
            shape = torch.broadcast_shapes(shape, key.shape[:-1])
        return self._belief(self._recursion(key).prior(shape, 0), key, 0)

    def _recursion(self, key: np.ndarray, *, compiled: bool = False) -> Recursion:
        """The steps with the numbers that the filter has now."""
        mean = wrapped_where(self.prior_mean, self._model.any_shape.state_angles)
        words = round_keys(key, mean.device)
        numbers = Numbers(self._known(), mean, self.prior_cov, self.measurement_noise_cov, words)
        arguments = self._stages, numbers, self.filter.size, self._model.substeps
        return CompiledRecursion(*arguments, self._programs) if compiled else Recursion(*arguments)

    @staticmethod
    def _belief(estimate: Estimate, key: np.ndarray, step: int, divergences: Tensor | None = None) -> TensorBelief:
        if divergences is None:
            mean = estimate.mean
            divergences = torch.zeros(mean.shape[:-1], dtype=torch.int64, device=mean.device)
        return TensorBelief(estimate.mean, estimate.cov, divergences, estimate.extras, key, step)

    def predict(self, belief: TensorBelief, u: Any) -> TensorBelief:
        """The belief a step later, under inputs u (..., p) in the units of the model's inputs."""
        u, step = self._finite("u", u, (self._model.inputs,)), belief.step + 1
        estimate = Estimate(belief.mean, belief.cov, belief.extras)
        predicted = self._recursion(belief.key).predict(estimate, u, step)
        return self._belief(predicted, belief.key, step, belief.divergences)

    def update(self, belief: TensorBelief, z: Any) -> tuple[TensorBelief, TensorInnovation]:
        """The belief after measurements z (..., m), NaN where missing, and the innovations.

        A belief that is not finite, or has a negative variance, becomes the prior, and this is counted.
        """
        z = self._finite("z", z, (self._model.channels,), missing_allowed=True)
        recursion, estimate = self._recursion(belief.key), Estimate(belief.mean, belief.cov, belief.extras)
        updated = recursion.update(estimate, z, belief.step)
        if updated.lost.any():
            updated = recursion.restarted(updated, belief.step)
        divergences = belief.divergences.expand(updated.lost.shape) + updated.lost
        belief = self._belief(updated.estimate, belief.key, belief.step, divergences)
        return belief, TensorInnovation(*updated.innovation)

    def run(self, inputs: Any = None, measurements: Any = None, keys: Any = None) -> TensorEstimates:
        """Filter trajectories, as `filters.run` does.

        Args:
            inputs: u (..., K, p), in the units of the model's inputs; None for a model without.
            measurements: z (..., K + 1, m), NaN where missing; z[..., 0, :] updates the prior.
            keys: (..., 2), of an ensemble's random numbers; those of `filters.run` if None.

        Raises:
            ValueError: if shapes do not fit, an input is not finite, or a measurement is infinite.
        """
        z = self._finite("measurements", measurements, (self._model.channels,), missing_allowed=True)
        if inputs is None:
            inputs = z.new_zeros(*z.shape[:-2], z.shape[-2] - 1, 0)
        u = self._finite("inputs", inputs, (self._model.inputs,))
        if z.ndim < 2 or u.ndim < 2 or u.shape[:-1] != (*z.shape[:-2], z.shape[-2] - 1):
            rule = "inputs and measurements must have shapes (..., K, p) and (..., K + 1, m)"
            raise ValueError(f"{rule}, but got {tuple(u.shape)} and {tuple(z.shape)}")
        batch = z.shape[:-2]
        if keys is None:
            keys = filter_keys(range(prod(batch))).reshape(*batch, 2) if self.filter.size else (0, 0)
        recursion = self._recursion(_checked_key(keys), compiled=bool(self._compiled))
        at_once = z.device.type in SYNCHRONOUS
        outputs, divergences = _filtered(recursion, u, z, restart=at_once)
        if not at_once and divergences.any():
            outputs, divergences = _filtered(recursion, u, z, restart=True)
        means, covs, values, innovation_covs, levels = zip(*outputs, strict=True)
        return TensorEstimates(
            torch.stack(means, -2),
            torch.stack(covs, -3),
            torch.stack(values, -2),
            torch.stack(innovation_covs, -3),
            torch.stack(levels, -1),
            divergences,
        )

    def log_likelihood(self, inputs: Any = None, measurements: Any = None) -> Tensor:
        """Log-likelihoods (B,) of trajectories by the compiled recursion, with its exact gradient along Q and R.

        It is what `run` sums up, some thousand times as fast, for `process_noise_cov` (n, n) and
        `measurement_noise_cov` (m, m). Other numbers are those of the filter's model.

        Args:
            inputs: (B, K, p); None for a model without.
            measurements: (B, K + 1, m), NaN where missing.

        Raises:
            ValueError: if shapes do not fit, or the filter has functions or other numbers than its model.
        """
        changeable = {name: getattr(self, name) for name in ("prior_mean", "prior_cov", "constants")}
        if (
            any(self._user_functions)
            or self._changed
            or not all(_is(tensor, getattr(self._model, name)) for name, tensor in changeable.items())
        ):
            rule = "the compiled log-likelihood needs the model's own functions, prior and constants"
            raise ValueError(f"{rule}, but got others: use run")
        noise = self.process_noise_cov, self.measurement_noise_cov
        return compiled_likelihood(self.filter, inputs, measurements, *noise)

    def _known(self) -> dict[Place, Tensor]:
        self._check_what_follows()
        memory, like = self._stages.memory, self.prior_mean
        own_parameters = {
            matrix: torch.as_tensor(value, dtype=like.dtype, device=like.device)
            for matrix, value in zip(memory.own, {**self._own, **self._changed}.values(), strict=False)
        }
        numbers = {
            memory.Q: self.process_noise_cov,
            memory.R: self.measurement_noise_cov,
            memory.constants: self.constants,
            memory.prior_mean: self.prior_mean,
        }
        covs = {memory.Q_root: self.process_noise_cov, memory.prior_root: self.prior_cov}
        covs[memory.R_root] = self.measurement_noise_cov
        numbers |= {matrix: root(cov) for matrix, cov in covs.items() if matrix in self._stages.reads}
        return {matrix.operation: value for matrix, value in (own_parameters | numbers).items()}

    def _check_what_follows(self) -> None:
        """Raise ValueError for other numbers, or derivatives, that the filter's parameters do not follow."""
        for parameter, names in with_page(self.filter, "a filter on tensors").follows_from.items():
            for name in () if parameter in self._changed else names:
                if not _is(getattr(self, name), getattr(self._model, name)):
                    raise ValueError(
                        f"{name} of {self.filter.name!r} on tensors must be the model's, without a gradient, as "
                        f"{parameter} was worked out from it: make the filter for another model"
                    )

    def _tensor(self, name: str, value: Any, shape: tuple[int, ...]) -> Tensor:
        """A value as a tensor (..., *shape) of the filter's dtype and on its device."""
        like = self.prior_mean
        try:
            tensor = torch.as_tensor(as_numbers(value), dtype=like.dtype, device=like.device)
        except (TypeError, ValueError, RuntimeError):
            raise ValueError(f"{name} must be a tensor of numbers, but got {short_repr(value)}") from None
        if tensor.shape[tensor.ndim - len(shape) :] != shape:
            wanted = ", ".join(("...", *map(str, shape)))
            raise ValueError(f"{name} must have shape ({wanted}), but got {tuple(tensor.shape)}")
        return tensor

    def _finite(self, name: str, value: Any, shape: tuple[int, ...], *, missing_allowed: bool = False) -> Tensor:
        """The same; ValueError for infinite numbers, and NaN unless it may be missing."""
        tensor = self._tensor(name, value, shape)
        wrong = torch.isinf(tensor) if missing_allowed else ~torch.isfinite(tensor)
        if wrong.any():
            rule = "finite or NaN" if missing_allowed else "finite"
            raise ValueError(f"{name} must be {rule}, but got {short_repr(tensor[wrong][0].item())}")
        return tensor


def _checked_key(key: Any) -> np.ndarray:
    key = np.asarray(key, dtype=np.float64)
    if key.shape[-1:] != (2,):
        raise ValueError(f"a key must be two whole numbers, (..., 2), but got shape {key.shape}")
    return key


def _filtered(
    recursion: Recursion, u: Tensor, z: Tensor, *, restart: bool
) -> tuple[list[tuple[Tensor, ...]], Tensor]:
    """Mean, covariance, innovation, S and log density of each step, and how often each trajectory is lost."""
    outputs: list[tuple[Tensor, ...]] = []
    inputs, measurements = (tensor.movedim(-2, 0).contiguous().unbind() for tensor in (u, z))
    for k, measurement in enumerate(measurements):
        if k == 0:
            step = recursion.first(measurement)
            divergences = torch.zeros_like(step.lost, dtype=torch.int64)
        else:
            step = recursion.step(step.estimate, inputs[k - 1], measurement, k)
        if restart and step.lost.any():
            step = recursion.restarted(step, k)
        divergences = divergences + step.lost
        outputs.append((step.estimate.mean, step.estimate.cov, *step.innovation))
    return outputs, divergences


def _is(tensor: Tensor, value: Any) -> bool:
    """Whether a tensor is a model's own number, and no derivative is asked for."""
    return not tensor.requires_grad and torch.equal(tensor, tensor.new_tensor(value))
