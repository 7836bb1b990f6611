"""How an estimator is trained: the one place of the defaults, without torch."""

from __future__ import annotations

from typing import NamedTuple


class Settings(NamedTuple):
    """How an estimator is trained.

    Attributes:
        steps: updates of the network's weights.
        batch: runs in each.
        window: steps of a run over which gradients go back; the next window begins where the last one ended.
        rate: Adam's step size at first; it falls to a hundredth along half a cosine.
        checks: evaluations on validation runs.
    """

    steps: int = 1000
    batch: int = 32
    window: int = 50
    rate: float = 5e-3
    checks: int = 20
