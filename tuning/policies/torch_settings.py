"""Settings of torch while a policy learns: the fastest for such small networks on a CPU."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from torch.distributions import Distribution

from thruster_env.core.threads import PASSIVE, one_thread, waiting
from tuning.policies.rollouts import epoch_minibatches
from tuning.policies.tanh import numpys_tanh


@contextmanager
def unchecked_distributions() -> Iterator[None]:
    """Within this context distributions do not look for NaN in every argument.

    A policy that has become NaN is still noticed, in the same step: the envs refuse its actions.
    """
    before = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(before)


def fuse_optimizers(model: BaseAlgorithm) -> None:
    """Have each Adam optimizer of a model update all parameters in one call, equal to rounding.

    Stable-Baselines3 leaves torch's default, a dozen calls for each parameter, which take longer than the numbers.
    """
    parameters: Any = model.get_parameters()  # that of optimizers, too, of which its annotation does not know
    for state in parameters.values():
        for group in state.get("param_groups", ()):
            group["fused"] = True
    model.set_parameters(parameters)


@contextmanager
def learning(model: BaseAlgorithm) -> Iterator[None]:
    """Within this context a model of Stable-Baselines3 learns as quickly as it can on one core.

    The result is the same except for rounding, of its optimizers and of tanh. torch has one thread and checks no
    arguments of distributions, minibatches are parts of an epoch's samples, and worker threads of vector envs
    sleep while torch works.

    Args:
        model: on the CPU.
    """
    fuse_optimizers(model)
    with (
        waiting(PASSIVE),
        one_thread(),
        unchecked_distributions(),
        epoch_minibatches(model),
        numpys_tanh(model.policy),
    ):
        yield
