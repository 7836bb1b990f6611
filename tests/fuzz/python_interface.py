"""Attacks on envs and filters from Python: random arguments, episodes, copies, beliefs and wrong types.

Whatever is refused must be so in one line that states a rule; whatever is accepted must lead to finite numbers.
"""

from __future__ import annotations

import copy
import math
import pickle
import time
from collections import Counter
from collections.abc import Callable, Iterator

import cloudpickle
import gymnasium as gym
import numpy as np

from filters import FILTERS, EstimateState, EstimateStates, make_filter, run, thruster_model
from filters.engine.belief import Belief, LostBelief
from filters.registry import filter_type
from tests.robustness.test_copies import assert_alike
from tests.thruster_env.thruster.test_robustness import random_arguments, run_random_episode
from thruster_env.core.compiled import interpreted

WAYS = (
    copy.deepcopy,
    *(lambda v, dumps=dumps: pickle.loads(dumps(v)) for dumps in (pickle.dumps, cloudpickle.dumps)),
)
EXTREME = (0.0, 5e-324, 1e-300, 1e-30, 1e8, -1e8, 1e30, -1e30, 1e154, 1e300, -1e308, math.inf, -math.inf, math.nan)
WRONG = (
    *("12", b"1", None, 1j, [1j], [None], {}, [], [[1.0], [2.0, 3.0]], "full", object(), True),
    *([1.0] * 3, 10**400),
)
NUMBERS = ("dt", "max_voltage", "ambient_velocity", "process_noise_cov", "measurement_noise_cov", "initial_state")


def constructions(rng: np.random.Generator, seconds: float) -> str:
    """Envs of random arguments, some of them absurd, and random episodes of those that are accepted."""
    counts = Counter()
    for _ in _until(seconds):
        name, arguments = random_arguments(rng)
        if rng.random() < 0.5:
            arguments[str(rng.choice(NUMBERS))] = _absurd(rng)
        env = _accepted(lambda: gym.make(name, disable_env_checker=True, **arguments), counts, arguments)  # noqa: B023
        if env is not None:
            try:
                counts["terminated"] += run_random_episode(env.unwrapped, rng, 20)
            except Exception as error:
                raise AssertionError(f"{name}, {arguments}: {error!r}") from error
            counts["episodes"] += 1
    return _line("constructions of envs", counts)


def copies(rng: np.random.Generator, seconds: float) -> str:
    """Envs, wrapped and in number, that are copied or pickled amid an episode and go on alike."""
    counts = Counter()
    with interpreted():
        for _ in _until(seconds):
            name, arguments = random_arguments(rng)
            env = _accepted(lambda: _some_env(rng, name, arguments), counts, arguments)  # noqa: B023
            if env is None:
                continue
            voltages = rng.uniform(-30.0, 30.0, size=(8, *env.action_space.shape))
            env.reset(seed=int(rng.integers(2**31)))
            for voltage in voltages[:3]:
                env.step(voltage)
            other = WAYS[rng.integers(len(WAYS))](env)
            for voltage in voltages[3:]:
                try:
                    assert_alike(env.step(voltage), other.step(voltage))
                except AssertionError as error:
                    raise AssertionError(
                        f"a copy of {env} with {arguments} goes on differently: {error}"
                    ) from error
            assert_alike(env.reset(), other.reset())
            counts["copies"] += 1
    return _line("copies of envs", counts)


def beliefs(rng: np.random.Generator, seconds: float) -> str:
    """Random beliefs, inputs and measurements, likely, absurd and none at all, in every filter's own functions."""
    counts, names = Counter(), list(FILTERS)
    with interpreted(), np.errstate(all="ignore"):
        for k in _until(seconds):
            name = names[k % len(names)]
            own = {"ensemble_size": 5} if filter_type(name).has_ensemble else {}
            kind = make_filter(name, thruster_model(), **own)
            belief = _some_belief(rng, kind.init((k % 2**32, 1)))
            u, z = ([_number(rng)] if rng.random() < 0.9 else WRONG[rng.integers(len(WRONG))] for _ in range(2))
            for use in (lambda: kind.predict(belief, u), lambda: kind.update(belief, z)[0]):  # noqa: B023
                given = name, belief, u, z
                after = _accepted(use, counts, given)
                if after is None:
                    continue
                belief = after
                finite = all(np.isfinite(part).all() for part in (after.mean, after.cov))
                assert finite or isinstance(after, LostBelief), given
                known = finite and kind.has_covariance and not isinstance(after, LostBelief)
                assert not known or (np.diag(after.cov) >= 0).all(), given
    return _line("beliefs", counts)


def wrong_types(rng: np.random.Generator, seconds: float) -> str:
    """What is no number, where seeds, options, actions, keys, covariances and batches of numbers are asked for."""
    counts, makers = Counter(), _makers()
    with interpreted():
        ekf = make_filter("ekf", thruster_model())
        for k in _until(seconds):
            wrong = WRONG[rng.integers(len(WRONG))]
            env = makers[k % len(makers)]()
            attacks = [
                lambda: env.reset(seed=wrong),  # noqa: B023
                lambda: env.reset(options=wrong),  # noqa: B023
                lambda: env.reset(options={"state": wrong}),  # noqa: B023
                lambda: ekf.init(wrong),  # noqa: B023
                lambda: ekf.predict(ekf.init(), [1.0], process_noise_cov=wrong),  # noqa: B023
                lambda: thruster_model(prior_cov_factor=wrong),  # noqa: B023
                lambda: ekf.model.replace(prior_mean=wrong, constants=wrong),  # noqa: B023
                lambda: run(ekf, wrong, wrong, wrong),  # noqa: B023
                lambda: EstimateState(gym.make("BowThruster-v0"), wrong),  # noqa: B023
            ]
            _accepted(attacks[rng.integers(len(attacks))], counts, wrong)
            env.reset(seed=k)
            before = env.unwrapped._copies.memory.copy()
            if _accepted(lambda: env.step(wrong), counts, wrong) is None:  # noqa: B023
                assert (env.unwrapped._copies.memory == before).all(), f"{env} moved before it refused {wrong!r}"
    return _line("wrong types", counts)


def _until(seconds: float) -> Iterator[int]:
    """0, 1, 2, ... until the time is over."""
    end, k = time.monotonic() + seconds, 0
    while k == 0 or time.monotonic() < end:
        yield k
        k += 1


def _accepted(call: Callable, counts: Counter, given):
    """What a call returns, or None where it is refused as it should be; both are counted."""
    try:
        result = call()
    except ValueError as error:
        text = str(error)
        assert " must " in text and "\n" not in text, f"refused without a rule: {text!r}, given {given!r}"
        counts["refused"] += 1
        return None
    except Exception as error:
        raise AssertionError(f"{type(error).__name__}: {error}, given {given!r}") from error
    counts["accepted"] += 1
    return result


def _line(what: str, counts: Counter) -> str:
    return f"{what}: " + ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))


def _number(rng) -> float:
    """A number, likely or extreme."""
    return float(rng.normal() * 5.0 if rng.random() < 0.6 else EXTREME[rng.integers(len(EXTREME))])


def _absurd(rng):
    """A number or some of them, extreme, or nothing of the kind."""
    if rng.random() < 0.3:
        return WRONG[rng.integers(len(WRONG))]
    return _number(rng) if rng.random() < 0.5 else [_number(rng), _number(rng)]


def _some_belief(rng, belief: Belief) -> Belief:
    """A belief with another mean or covariance: ill-scaled, indefinite, not finite or as it was."""
    scale = 10.0 ** rng.uniform(-8.0, 8.0, size=2)
    factor = rng.normal(size=(2, 2)) * scale[:, None]
    covs = (belief.cov, factor @ factor.T, (factor + factor.T) * scale[0], np.full((2, 2), _number(rng)), "cov")
    means = (belief.mean, rng.normal(size=2) * scale, np.array([_number(rng), _number(rng)]))
    return belief._replace(mean=means[rng.integers(3)], cov=covs[rng.choice(5, p=[0.2, 0.4, 0.2, 0.15, 0.05])])


def _makers() -> list[Callable]:
    """Envs, single and in number, without and with a filter."""
    return [
        lambda: gym.make("BowThruster-v0").unwrapped,
        lambda: gym.make_vec("BowThruster-v0", 2),
        lambda: EstimateState(gym.make("BowThruster-v0").unwrapped),
        lambda: EstimateStates(gym.make_vec("BowThruster-v0", 2)),
    ]


def _some_env(rng, name: str, arguments: dict):
    """One of these of random arguments, with a filter where the model knows its sensors."""
    if rng.random() < 0.5:
        env = gym.make(name, disable_env_checker=True, **arguments)
        return EstimateState(env, str(rng.choice(["ekf", "enkf", "pf"]))) if rng.random() < 0.5 else env
    mode = str(rng.choice(["NextStep", "SameStep"]))
    env = gym.make_vec(name, 3, autoreset_mode=mode, **arguments)
    return EstimateStates(env, str(rng.choice(["ekf", "enkf", "pf"]))) if rng.random() < 0.5 else env
