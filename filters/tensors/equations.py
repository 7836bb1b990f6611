"""A model's equations on batches of tensors: graphs of numbers if they can be traced, else as they stand.

A component of a state is a tensor (...,), so that an operation of the graph is one of torch for a whole batch, and
the points of a sigma-point filter are one more dimension. The Jacobian of an equation that is called, such as a
network, is found forwards, by `torch.func.jvp` along each component, unless the user gives it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_unflatten

from filters.tensors.graphs import stacked, values_of, with_finite_slope
from filters.tensors.stages import (
    FULL_TURN,
    LOW,
    MULTIPLIERS,
    ROUNDS,
    TWO_TO_MINUS_32,
    Draw,
    Equation,
    Stages,
    where,
)
from thruster_env.core.compiled import needs_floats
from thruster_env.core.sources import is_array
from thruster_env.graphs.graphs import Graph, Number, needed_by
from thruster_env.graphs.programs import Place
from thruster_env.model.shape import LANES, Shape, constants_are_array, padded
from thruster_env.model.traced import MOST, Traced

POINTS = 64  # at which functions of tensors are compared with those of floats
ASKING = frozenset("__bool__ __float__ __int__ __index__ __complex__ item".split())
# Of torch: a function of tensors may do so and give derivatives.
LEAVING = frozenset("tolist numpy __array__".split())


def sizes_of(which: str, shape: Shape) -> tuple[int, ...]:
    """How many components the arguments (x, u, c), or (x, c) of an h without input, have."""
    if which == "motion" or shape.feeds:
        return shape.n, shape.inputs, shape.constants
    return shape.n, shape.constants


class OfGraph:
    """An equation whose function can be traced; the Jacobian shares operations with the value."""

    def __init__(self, function: Callable, jacobian: Callable | None, which: str, shape: Shape):
        value, matrix, *_ = Traced(function, jacobian, which, shape).parts
        graph = Graph(MOST)
        x, *rest = (
            np.array([graph.given((part, k)) for k in range(size)], dtype=object)
            for part, size in enumerate(sizes_of(which, shape))
        )
        self._value = [graph.number(entry) for entry in value(x, *rest)]
        self._both = self._value + [graph.number(entry) for entry in matrix(x, None, *rest).ravel()]
        self._orders = [needed_by(wanted) for wanted in (self._value, self._both)]

    def of_points(self, x: Tensor, *arguments: Tensor) -> Tensor:
        """The values (..., rows, points) at points (..., n, points)."""
        values = self._stacked(self._value, self._orders[0], _components_of_points(x, *arguments))
        return values.movedim(-1, -2)

    def with_jacobian(self, x: Tensor, *arguments: Tensor) -> tuple[Tensor, Tensor]:
        """The value (..., rows), and dy/dx (..., rows, n), at x (..., n)."""
        both = self._stacked(self._both, self._orders[1], _components(x, *arguments))
        rows = len(self._value)
        return both[..., :rows], both[..., rows:].unflatten(-1, (rows, x.shape[-1]))

    @staticmethod
    def _stacked(wanted: Sequence[Number], order: Sequence[Number], parts: list[tuple[Tensor, ...]]) -> Tensor:
        components = {(p, k): component for p, part in enumerate(parts) for k, component in enumerate(part)}
        return stacked(values_of(wanted, order, components, parts[0][0]), parts)


class _NoNumberAsked(TorchFunctionMode):
    """Within this context no batch of tensors is asked for a number, and none that has derivatives for a float."""

    def __init__(self, asking: frozenset[str]):
        super().__init__()
        self._asking = asking

    def __torch_function__(self, function, types, arguments=(), named=None):
        name = getattr(function, "__name__", "")
        if name in self._asking:
            asked = arguments[0]
            if asked.numel() > 1 or asked.requires_grad and name != "__bool__":
                raise TypeError(
                    f"a tensor was asked for one number ({name.strip('_')}), which holds for no batch and loses "
                    "derivatives; torch's functions and torch.where take tensors"
                )
        return function(*arguments, **(named or {}))


ROOTS = {name: name for name in ("sqrt", "hypot", "arcsin", "arccos", "arccosh", "arctan2", "pow")}
ROOTS |= {"asin": "arcsin", "acos": "arccos", "acosh": "arccosh", "atan2": "arctan2", "__pow__": "pow"}
"""Functions of torch whose slope is infinite or NaN where they are finite: a root at zero."""


class _FiniteSlopes(TorchFunctionMode):
    """Within this context a root at zero has no slope, as in a graph; autograd's is infinite, and makes NaN."""

    def __torch_function__(self, function, types, arguments=(), named=None):
        name = ROOTS.get(getattr(function, "__name__", ""))
        tensors = [tensor for tensor in arguments if isinstance(tensor, Tensor)]
        if name is None or named or not all(tensor.is_floating_point() for tensor in tensors):
            return function(*arguments, **(named or {}))
        return with_finite_slope(name, function, arguments)


class Called:
    """An equation whose function takes tensors (...,) in the places of floats."""

    def __init__(
        self, name: str, function: Callable, jacobian: Callable | None, shape: Shape, of_floats: bool = False
    ):
        self._name, self._function, self._jacobian, self._shape = name, function, jacobian, shape
        self._unproven = {self._function, self._entries}  # functions that have not yet been called with a batch
        self._of_floats = of_floats

    def _value(self, x: Tensor, *arguments: Tensor) -> Tensor:
        return self._called(self._function, _components(x, *arguments))

    def of_points(self, x: Tensor, *arguments: Tensor) -> Tensor:
        """The values (..., rows, points) at points (..., n, points)."""
        return self._called(self._function, _components_of_points(x, *arguments)).movedim(-1, -2)

    def with_jacobian(self, x: Tensor, *arguments: Tensor) -> tuple[Tensor, Tensor]:
        """The value (..., rows), and dy/dx (..., rows, n), at x (..., n)."""
        if self._jacobian is not None:
            matrix = self._called(self._entries, _components(x, *arguments))
            return self._value(x, *arguments), matrix.unflatten(-1, (-1, x.shape[-1]))
        x, columns = x.contiguous(), []  # jvp takes no tensor that is one number many times
        for unit in torch.eye(x.shape[-1], dtype=x.dtype, device=x.device):
            tangent = unit.expand_as(x).contiguous()
            value, column = torch.func.jvp(lambda x: self._value(x, *arguments), (x,), (tangent,))[:2]
            columns.append(column)
        return value, torch.stack(columns, -1)

    def _entries(self, *arguments) -> list[Tensor | float]:
        return [entry for row in self._jacobian(*arguments) for entry in row]  # type: ignore[misc]

    def _called(self, function: Callable, parts: list[tuple[Tensor, ...]]) -> Tensor:
        x, *u, c = parts
        u = [tuple(tensor.expand_as(x[0]) for tensor in part) for part in u]  # so that they can be stacked with x
        states, *inputs = (torch.stack(part) if is_array(len(part)) else part for part in (x, *u))
        try:
            if function in self._unproven:
                self._prove(function, parts)  # which is refused at each call, or passes once
                self._unproven.discard(function)
            with _FiniteSlopes():
                values = function(states, *inputs, self._constants(c))
            return stacked(values, parts)
        except (TypeError, ValueError, AttributeError, RuntimeError) as error:
            rule = f"{self._name} must accept tensors, or consist of arithmetic without branches"
            raise ValueError(f"{rule}, but raised {type(error).__name__}: {str(error).splitlines()[0]}") from error

    def _prove(self, function: Callable, parts: list[tuple[Tensor, ...]]) -> None:
        """Raise TypeError if a function asks a state for a number: for one trajectory it would be answered."""
        *components, c = parts
        size = sum(map(len, components))
        values = torch.as_tensor(np.sin(np.outer(np.arange(1.0, size + 1.0), 0.1 + np.arange(POINTS))))
        values = (values * torch.logspace(-1.0, 1.0, POINTS)).to(c[0] if c else components[0][0])
        rows = list(values.unbind(0))
        *arguments, constants = [*_split(rows, [*map(len, components)]), self._constants(c)]
        try:
            with _NoNumberAsked(ASKING | LEAVING if self._of_floats else ASKING):
                results = [*function(*arguments, constants)]
        except TypeError as error:
            if "asked for one number" in str(error):
                raise
            return
        except Exception:  # other limits of a function are its own: it may be meant for one trajectory
            return
        if self._of_floats and function is self._function and all(constant.numel() == 1 for constant in c):
            self._compare(results, values, [*map(len, components)], [float(constant) for constant in c])

    def _compare(self, results: list, values: Tensor, sizes: list[int], c: list[float]) -> None:
        """Raise TypeError unless tensors (rows of points) have the values of floats, where these are finite."""
        for k, point in enumerate(values.double().T.tolist()):
            arguments = _split(point, sizes)
            try:
                expected = np.array(self._function(*arguments, self._constants(c)), dtype=np.float64)
            except (ArithmeticError, ValueError):
                continue
            tensors = np.array(
                [float(result.expand(POINTS)[k]) if isinstance(result, Tensor) else result for result in results]
            )
            if np.isfinite(expected).all() and not np.allclose(tensors, expected, rtol=1e-4, atol=1e-5):
                raise TypeError("of tensors it has other values than of floats: a sum of comparisons is no number")

    def _constants(self, c: Sequence):
        form = self._shape.form
        if constants_are_array(form):
            return torch.stack(tuple(c)) if isinstance(c[0], Tensor) else np.array(c)
        return tuple(c) if isinstance(form, int) else form(*c)


def _split(values: list, sizes: Sequence[int]) -> list:
    arguments, first = [], 0
    for size in sizes:
        part = values[first : first + size]
        stack: Callable = torch.stack if part and isinstance(part[0], Tensor) else np.array
        arguments.append(stack(part) if is_array(size) else tuple(part))
        first += size
    return arguments


def _components(*arguments: Tensor) -> list[tuple[Tensor, ...]]:
    return [tensor.unbind(-1) for tensor in arguments]


def _components_of_points(x: Tensor, *arguments: Tensor) -> list[tuple[Tensor, ...]]:
    return [x.unbind(-2), *(tensor[..., None].unbind(-2) for tensor in arguments)]


def equation_of(
    name: str,
    of_model: tuple[Callable, Callable | None],
    user_functions: tuple[Callable | None, Callable | None],
    shape: Shape,
) -> Equation:
    """The equation of a model's function and Jacobian, or of functions of tensors in their place.

    Args:
        name: of the function in the model.
        of_model: its function, and its Jacobian or None.
        user_functions: function and Jacobian of tensors; None for the model's.
        shape: of the model.
    """
    function, jacobian = user_functions
    if function is not None:
        return Called(name, function, jacobian, shape)
    if jacobian is not None:
        raise ValueError(f"{name}_jacobian must come with {name}, but got it alone")
    try:
        return OfGraph(*of_model, "motion" if name == "transition" else "sight", shape)
    except Exception:  # a user's function cannot be traced, whatever it raises: it is called instead
        if reason := needs_floats(*of_model):
            raise ValueError(f"{name} must accept tensors, but {reason}") from None
        return Called(name, *of_model, shape, of_floats=True)


# The steps of a filter on tensors for one set of numbers, as they stand or compiled by `torch.compile`.
#
# Nothing here asks the device for a number, so that a processor issues a step's operations without waiting for
# them.


class Estimate(NamedTuple):
    """Mean (..., n), covariance (..., n, n) and extras by name."""

    mean: Tensor
    cov: Tensor
    extras: dict[str, Tensor]


class Step(NamedTuple):
    """An estimate after an update; innovation, S and log density; and which trajectories (...,) are lost."""

    estimate: Estimate
    innovation: list[Tensor]
    lost: Tensor


class Numbers(NamedTuple):
    """What a recursion reads: the numbers of pages, the prior, R for restarts, and words of random numbers."""

    known: dict[Place, Tensor]
    prior_mean: Tensor  # (..., n), angles on their branch
    prior_cov: Tensor
    measurement_noise_cov: Tensor
    words: Tensor  # `draws.round_keys`


def normals_of(words: Tensor, step: int | Tensor, size: int, like: Tensor) -> Draw:
    """A function that draws normals (..., rows, size) for `round_keys` (..., 10, 2), those of `filters.run`.

    Products of 32-bit words wrap around in 64 signed bits, of which only the lower halves count.
    """
    width = padded(size, LANES)

    def draw(stream: int, rows: int) -> Tensor:
        block = torch.arange(rows * width // 4, device=words.device)
        nothing = torch.zeros_like(block)
        c0, c1, c2, c3 = block, nothing + step, nothing + stream, nothing
        for k in range(ROUNDS):
            products = [factor * (c & LOW) for factor, c in zip(MULTIPLIERS, (c0, c2), strict=True)]
            first, second = (words[..., k, part, None] for part in range(2))
            c1, c3 = (products[1] >> 32) ^ c1 ^ first, (products[0] >> 32) ^ c3 ^ second
            c0, c1, c2, c3 = c1, products[1], c3, products[0]
        uniforms = [((c & LOW).double() + 0.5) * TWO_TO_MINUS_32 for c in (c0, c1, c2, c3)]
        normals = []
        for share, turns in (uniforms[:2], uniforms[2:]):
            radius, angle = (-2.0 * share.log()).sqrt(), FULL_TURN * (turns - 0.5)
            normals += [radius * angle.cos(), radius * angle.sin()]
        return torch.stack(normals, -1).unflatten(-2, (rows, -1)).flatten(-2)[..., :size].to(like.dtype)

    return draw


class Recursion:
    """The steps of a filter, for numbers that stay the same."""

    def __init__(self, stages: Stages, numbers: Numbers, size: int, substeps: int):
        """Take the stages of a page; `size` is of the ensemble."""
        self._stages, self._numbers, self._size, self._substeps = stages, numbers, size, substeps

    def _draw(self, step: int | Tensor) -> Draw:
        return normals_of(self._numbers.words, step, self._size, self._numbers.prior_mean)

    def prior(self, batch: tuple[int, ...], step: int | Tensor) -> Estimate:
        """The prior for a batch of trajectories, and those of the numbers."""
        mean, cov = self._numbers.prior_mean, self._numbers.prior_cov
        shape = torch.broadcast_shapes(batch, mean.shape[:-1], cov.shape[:-2])
        prior = mean.expand(*shape, -1), cov.expand(*shape, -1, -1)
        return Estimate(*self._stages.start(self._numbers.known, prior, self._draw(step)))

    def predict(self, estimate: Estimate, u: Tensor, step: int | Tensor) -> Estimate:
        """The estimate a step later, which has this number."""
        known = self._numbers.known
        return Estimate(*self._stages.predict(known, tuple(estimate), u, self._substeps, self._draw(step)))

    def update(self, estimate: Estimate, z: Tensor, step: int | Tensor) -> Step:
        """The estimate after z, and what is lost: not finite, or of a negative variance."""
        updated, innovation = self._stages.update(self._numbers.known, tuple(estimate), z, self._draw(step))
        return Step(Estimate(*updated), innovation, ~_all_finite(*updated[:2], *innovation))

    def first(self, z: Tensor) -> Step:
        """The prior, updated with the first measurements."""
        return self.update(self.prior(z.shape[:-1], 0), z, 0)

    def step(self, estimate: Estimate, u: Tensor, z: Tensor, step: int | Tensor) -> Step:
        """The estimate a step later, updated with measurements."""
        return self.update(self.predict(estimate, u, step), z, step)

    def restarted(self, after: Step, step: int) -> Step:
        """The prior in place of lost estimates, with R for S, and zero for innovation and log density."""
        lost, (mean, cov, extras), (v, s, level) = after.lost, after.estimate, after.innovation
        prior, sizes = self.prior(lost.shape, step), self._stages.extra_dimensions
        estimate = Estimate(
            where(lost, prior.mean, mean, 1),
            where(lost, prior.cov, cov, 2),
            {name: where(lost, prior.extras[name], extra, sizes[name]) for name, extra in extras.items()},
        )
        r = self._numbers.measurement_noise_cov
        innovation = where(lost, torch.zeros_like(v), v, 1), where(lost, r, s, 2), torch.where(lost, 0.0, level)
        return Step(estimate, [*innovation], lost)


class CompiledRecursion(Recursion):
    """The same steps, each as one program of `torch.compile` for the shapes of its arguments.

    The operations on tensors are recorded once, without the Python that issues them, and then fused.
    """

    def __init__(
        self, stages: Stages, numbers: Numbers, size: int, substeps: int, programs: dict[Any, tuple[Callable, Any]]
    ):
        """Take the stages of a page, and programs by name and shapes, to which further ones are added."""
        super().__init__(stages, numbers, size, substeps)
        self._programs = programs

    def first(self, z: Tensor) -> Step:
        """The prior, updated with the first measurements."""
        return self._run("first", Recursion.first, z)

    def step(self, estimate: Estimate, u: Tensor, z: Tensor, step: int | Tensor) -> Step:
        """The estimate a step later, updated with measurements."""
        number = torch.full((), int(step), device=z.device)
        return self._run("step", Recursion.step, estimate, u, z, number)

    def _run(self, name: str, function: Callable, *arguments: Any) -> Step:
        tensors, structure = tree_flatten((self._numbers, arguments))
        key = name, *((tensor.shape, tensor.dtype, tensor.device) for tensor in tensors)
        if key not in self._programs:
            self._programs[key] = self._compiled(function, tensors, structure)
        program, result = self._programs[key]
        return tree_unflatten(program(*tensors), result)

    def _compiled(self, function: Callable, tensors: list[Tensor], structure: Any) -> tuple[Callable, Any]:
        """A program of tensors, and the structure of its results."""
        results = []

        def flat(*tensors: Tensor) -> list[Tensor]:
            numbers, arguments = tree_unflatten(tensors, structure)
            plain = Recursion(self._stages, numbers, self._size, self._substeps)
            values, result = tree_flatten(function(plain, *arguments))
            results.append(result)
            return values

        recorded = make_fx(flat)(*(tensor.detach() for tensor in tensors))
        return torch.compile(recorded, dynamic=False), results[-1]


def _all_finite(mean: Tensor, cov: Tensor, *innovation: Tensor) -> Tensor:
    """Which beliefs (...,) and innovations consist of finite numbers, with variances that are not negative."""
    v, s, level = innovation
    sums = mean.abs().sum(-1) + cov.abs().sum((-2, -1)) + v.abs().sum(-1) + s.abs().sum((-2, -1)) + level.abs()
    return sums.isfinite() & (torch.diagonal(cov, dim1=-2, dim2=-1) >= 0).all(-1)
