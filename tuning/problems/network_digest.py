"""Texts that identify networks of torch, and policies of Stable-Baselines3, by their parameters; see `digest`."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np


def is_network(value: Any) -> bool:
    """Whether something is a tensor or a network of torch, or an algorithm of Stable-Baselines3."""
    torch: Any = sys.modules.get("torch")
    if not hasattr(torch, "nn"):
        return False
    return isinstance(value, torch.Tensor | torch.nn.Module) or _policy_of(value) is not None


def of_network(value: Any, of: Callable[[Any], Iterator[str]]) -> Iterator[str]:
    """Texts of its layers and its parameters; of an algorithm those of its policy, for the rest is of learning."""
    torch: Any = sys.modules["torch"]
    policy = _policy_of(value)
    if isinstance(value, torch.Tensor):
        yield from _of_tensor(value)
    elif policy is not None:
        yield from of((policy, value.observation_space, value.action_space))
    else:
        for name, part in value.named_modules():
            yield f"{name} {type(part).__qualname__} {part.extra_repr()}"
            if part is not value:
                yield from of(type(part))
        for name, tensor in sorted(value.state_dict().items()):
            yield name
            yield from _of_tensor(tensor) if isinstance(tensor, torch.Tensor) else of(tensor)


def _of_tensor(tensor: Any) -> Iterator[str]:
    plain = tensor.detach().cpu()
    numbers = np.ascontiguousarray((plain.double() if plain.is_floating_point() else plain).numpy())
    yield f"tensor {tensor.dtype} {tuple(tensor.shape)} {hashlib.sha256(numbers.tobytes()).hexdigest()}"


def _policy_of(value: Any) -> Any:
    """The network of an algorithm of Stable-Baselines3 or its contributions; None for anything else."""
    torch: Any = sys.modules["torch"]
    named = any(kind.__name__ == "BaseAlgorithm" for kind in type(value).__mro__)
    found = getattr(value, "policy", None) if named else None
    return found if isinstance(found, torch.nn.Module) else None
