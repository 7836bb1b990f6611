"""What makes learning quick changes nothing but rounding: minibatches, optimizers, tanh, checks left out."""
# ruff: noqa: F811 - fixtures come by import and go by name

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

import torch
from gymnasium.spaces import Box
from stable_baselines3.common.buffers import RolloutBuffer
from torch.distributions import Distribution

from tests.learners import setup_of, short_episodes  # noqa: F401 - a fixture
from thruster_env.core.parallel import wait_policy
from tuning.policies.algorithms import ALGORITHMS
from tuning.policies.environments import make_environments
from tuning.policies.learn import EpochBuffer, NumpyTanh, learning, new_model, numpys_tanh

SEEDS = range(4)


@pytest.mark.parametrize("size", [None, 5, np.int64(6), 100])
def test_minibatches_are_those_of_stable_baselines3_to_the_bit(size):
    found = []
    for kind in (RolloutBuffer, EpochBuffer):
        rng = np.random.default_rng(3)
        buffer = kind(6, Box(-1, 1, (4,), np.float32), Box(-1, 1, (2,), np.float32), "cpu", n_envs=3)
        for _ in range(6):
            parts = [rng.normal(size=(3, *shape)).astype(np.float32) for shape in ((4,), (2,), (), (), (), ())]
            buffer.add(*parts[:4], *map(torch.from_numpy, parts[4:]))
        buffer.compute_returns_and_advantage(torch.ones(3), np.zeros(3))
        np.random.seed(0)
        found.append([batch for _ in range(2) for batch in buffer.get(size)])
    theirs, ours = found
    assert len(ours) == len(theirs) == 2 * len(range(0, 18, size or 18))
    for batch, expected in zip(ours, theirs, strict=True):
        assert all(torch.equal(*pair) for pair in zip(batch, expected, strict=True))


def optimizers_of(model):
    return {name: state for name, state in model.get_parameters().items() if "param_groups" in state}


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_while_a_model_learns_every_optimizer_is_fused_and_torch_is_given_back_as_it_was(algo):
    setup = setup_of(algo=algo)
    model = new_model(setup, make_environments(setup, SEEDS))
    before = torch.get_num_threads(), Distribution._validate_args, wait_policy()
    torch.set_num_threads(2)
    try:
        with pytest.raises(KeyboardInterrupt), learning(model):
            assert torch.get_num_threads() == 1 and not Distribution._validate_args and wait_policy() == "passive"
            assert isinstance(getattr(model, "rollout_buffer", None), EpochBuffer) == (algo == "ppo")
            raise KeyboardInterrupt
        assert not isinstance(getattr(model, "rollout_buffer", None), EpochBuffer)
        assert (torch.get_num_threads(), Distribution._validate_args, wait_policy()) == (2, *before[1:])
    finally:
        torch.set_num_threads(before[0])
    found = optimizers_of(model)
    assert len(found) == {"ppo": 1, "recurrent-ppo": 1, "sac": 3, "td3": 2}[algo]
    assert all(group["fused"] for state in found.values() for group in state["param_groups"])


def test_tanh_and_its_derivative_are_those_of_torch():
    quick, x = NumpyTanh(), torch.linspace(-12, 12, 4001).reshape(-1, 1).requires_grad_()
    assert torch.autograd.gradcheck(quick, torch.linspace(-3, 3, 21, dtype=torch.float64).requires_grad_())
    with torch.no_grad():
        torch.testing.assert_close(quick(x), torch.tanh(x), rtol=3e-7, atol=0)
    quickly, usual = (torch.autograd.grad(f(x).sum(), x)[0] for f in (quick, torch.tanh))
    torch.testing.assert_close(quickly, usual, rtol=1e-6, atol=3e-7)


@pytest.mark.parametrize("kind", [{"dtype": torch.bfloat16}, {"dtype": torch.int64}, {"device": "meta"}])
@pytest.mark.parametrize("shape", [(), (3,)])
def test_of_what_numpy_cannot_hold_tanh_is_torchs(kind, shape):
    x = torch.ones(shape, **kind)
    found, usual = NumpyTanh()(x), torch.tanh(x)
    assert (found.dtype, found.device, found.shape) == (usual.dtype, usual.device, usual.shape)
    assert found.is_meta or torch.equal(found, usual)


@pytest.mark.parametrize("algo", ["ppo", "recurrent-ppo", "sac"])
def test_only_while_a_model_learns_tanh_is_numpys(algo):
    setup = setup_of(algo=algo)
    policy = new_model(setup, make_environments(setup, SEEDS)).policy
    kinds = [type(module) for module in policy.modules()]
    with pytest.raises(KeyboardInterrupt), numpys_tanh(policy):
        inside = {type(module) for module in policy.modules()}
        assert (NumpyTanh in inside) == (torch.nn.Tanh in kinds) and torch.nn.Tanh not in inside
        raise KeyboardInterrupt
    assert [type(module) for module in policy.modules()] == kinds and NumpyTanh not in kinds


def learnt(quickly):
    setup, steps = setup_of(), 384  # three rollouts; the last one is learnt from at the rate zero
    model = new_model(setup, make_environments(setup, SEEDS))
    if quickly:
        with learning(model):
            model.learn(steps)
    else:
        model.learn(steps)
    return torch.nn.utils.parameters_to_vector(model.policy.parameters()).detach().numpy()


def test_what_is_learnt_is_what_stable_baselines3_learns_by_itself_but_for_rounding():
    setup = setup_of()
    first = new_model(setup, make_environments(setup, SEEDS)).policy.parameters()
    start = torch.nn.utils.parameters_to_vector(first).detach().numpy()
    ours, theirs = learnt(quickly=True), learnt(quickly=False)
    moved = abs(theirs - start).max()
    assert moved > 1e-3 and abs(ours - theirs).max() < 1e-4 * moved


def test_a_policy_that_has_become_nan_is_noticed_in_the_same_step():
    setup = setup_of()
    model = new_model(setup, make_environments(setup, SEEDS))
    with learning(model), pytest.raises(ValueError, match="not NaN"):
        torch.nn.init.constant_(model.policy.action_net.bias, float("nan"))
        model.learn(8)
