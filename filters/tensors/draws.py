"""An ensemble's normals on any device: the generator of `thruster_env.core.streams`, of tensors.

Source: Salmon, Moraes, Dror, Shaw (2011), "Parallel random numbers: as easy as 1, 2, 3"; normals by Box and
Muller (1958).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from thruster_env.model.shape import LANES, padded

Draw = Callable[[int, int], Tensor]
"""draw(stream, rows): standard normals (..., rows, size)."""

ROUNDS = 10
MULTIPLIERS, WEYL, LOW = (0xD2511F53, 0xCD9E8D57), (0x9E3779B9, 0xBB67AE85), 0xFFFFFFFF
TURN, TWO_TO_MINUS_32 = 2.0 * np.pi, 2.0**-32


def round_keys(key: np.ndarray, device: torch.device) -> Tensor:
    """The words of all rounds, (..., 10, 2), of keys (..., 2)."""
    words = np.asarray(key).astype(np.uint64).astype(np.int64)[..., None, :]
    return torch.as_tensor((words + np.outer(np.arange(ROUNDS), WEYL)) & LOW, device=device)


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
            radius, angle = (-2.0 * share.log()).sqrt(), TURN * (turns - 0.5)
            normals += [radius * angle.cos(), radius * angle.sin()]
        return torch.stack(normals, -1).unflatten(-2, (rows, -1)).flatten(-2)[..., :size].to(like.dtype)

    return draw
