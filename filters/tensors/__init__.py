"""Filters on batches of tensors, for models with a network in them and for other devices; this alone needs torch.

equations   a model's functions and their Jacobians, of tensors; a filter's steps for one set of numbers
stages      a page as functions of tensors (..., rows, columns), and random numbers on the device
filter      `TensorFilter`: init, predict, update, run, and the likelihood by the compiled recursion
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from thruster_env.core.modules import to_install

if TYPE_CHECKING:
    from filters.filter import Filter
    from filters.tensors.filter import TensorFilter


def torch(filter_: Filter, **arguments: Any) -> TensorFilter:
    """A filter on batches of tensors, differentiable by torch; arguments are those of `TensorFilter`.

    Raises:
        ValueError: if torch is not installed, for a filter without a page or in the form "ud", or for a
            wrong argument.
    """
    if find_spec("torch") is None:
        raise ValueError(f"filters.torch needs torch, which is not installed: {to_install('torch')}")
    form = getattr(filter_, "form", "")
    if form == "ud":
        raise ValueError(f"a filter on tensors must have another form, such as 'square-root', but got {form!r}")
    from filters.tensors.filter import TensorFilter

    return TensorFilter(filter_, **arguments)
