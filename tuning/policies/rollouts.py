"""`EpochBuffer`: rollouts that are put into random order once an epoch, and handed out as views."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import RolloutBufferSamples


class EpochBuffer(RolloutBuffer):
    """A `RolloutBuffer` with the same minibatches, to the bit, in a third of the time.

    Stable-Baselines3 gathers and copies six arrays for each minibatch. Here all samples of an epoch are gathered
    at once, in the same random order, and a minibatch is a part of that.
    """

    def get(self, batch_size: int | None = None) -> Generator[RolloutBufferSamples, None, None]:
        """The minibatches of one epoch; all samples in one without `batch_size`."""
        (epoch,) = super().get()
        size = len(epoch.actions) if batch_size is None else int(batch_size)  # torch refuses NumPy's integers
        for parts in zip(*(tensor.split(size) for tensor in epoch), strict=True):
            yield RolloutBufferSamples(*parts)


@contextmanager
def epoch_minibatches(model: BaseAlgorithm) -> Iterator[None]:
    """Within this context a model with a `RolloutBuffer` has an `EpochBuffer` in its place."""
    holder: Any = model
    before = getattr(holder, "rollout_buffer", None)
    if type(before) is not RolloutBuffer:
        yield
        return
    names = ("buffer_size", "observation_space", "action_space", "device", "gae_lambda", "gamma", "n_envs")
    holder.rollout_buffer = EpochBuffer(**{name: getattr(before, name) for name in names})
    try:
        yield
    finally:
        holder.rollout_buffer = before
