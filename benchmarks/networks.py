"""What a step of learning needs of the processor at least: the products with the weights of its networks."""

from __future__ import annotations

from itertools import pairwise

from benchmarks.timing import alone, seconds_a_call
from tuning.policies.setup import TrainingConfiguration

NETWORKS = 2  # one of the action, one of the value, which is a single number, too
PASSES = 3  # through them in a step of gradient descent: the output, then slopes over weights and over inputs


def network_limit(setup: TrainingConfiguration) -> float:
    """Seconds a step of PPO's products with its networks' weights, at torch's rate in one thread."""
    from tuning.policies.environments import make_environments

    envs, parameters = make_environments(setup, [0]), dict(setup.hyperparameters)
    layers = [
        envs.observation_space.shape[0],
        *parameters["policy_kwargs"]["net_arch"],
        envs.action_space.shape[0],
    ]
    weights = NETWORKS * sum(a * b for a, b in pairwise(layers))
    rate = seconds_a_product(parameters["batch_size"], max(layers))
    return weights * (1 + PASSES * parameters["n_epochs"]) * rate


def seconds_a_product(rows: int, width: int) -> float:
    """Seconds of one multiplication and addition in a product (rows, width) (width, width) of float32."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        multiply = seconds_a_call(torch.mm, 50 * [(torch.ones(rows, width), torch.ones(width, width))])
        return alone(multiply, 100).ours / (rows * width * width)
    finally:
        torch.set_num_threads(threads)
