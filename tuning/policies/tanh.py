"""tanh, the activation of a policy's hidden layers, by NumPy, whose vector code serves processors of all makers.

torch's comes from Intel's library, and takes ten times as long on an AMD: longer than a layer's product.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

TAKEN = torch.float32, torch.float64


class _Tanh(torch.autograd.Function):
    """y = tanh(x), dy/dx = 1 - y^2."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = _evaluate(x)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(gradient, y)


class NumpyTanh(nn.Module):
    """tanh(x), equal to `torch.nn.Tanh` except for rounding; torch's own for types that NumPy does not have."""

    def forward(self, x: Tensor) -> Tensor:
        """Return tanh(x)."""
        if x.dtype not in TAKEN or not x.is_cpu or not x.ndim:
            return torch.tanh(x)
        return _Tanh.apply(x) if x.requires_grad else _evaluate(x)


def _evaluate(x: Tensor) -> Tensor:
    return torch.from_numpy(np.tanh(x.detach().numpy()))


@contextmanager
def numpys_tanh(network: nn.Module) -> Iterator[None]:
    """Within this context each `torch.nn.Tanh` of a network is NumPy's; saved files do not record it."""
    found = [
        (parent, name, child)
        for parent in network.modules()
        for name, child in parent.named_children()
        if type(child) is nn.Tanh
    ]
    quick = NumpyTanh()
    try:
        for parent, name, _ in found:
            setattr(parent, name, quick)
        yield
    finally:
        for parent, name, child in found:
            setattr(parent, name, child)
