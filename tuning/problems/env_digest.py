"""What identifies the env of a problem: its id or function, the classes of its layers, an object's attributes."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from thruster_env.core.global_generators import GlobalGenerators
from tuning.problems.code_digest import is_of_a_library
from tuning.problems.digest import digest_of, held_by, layers


def env_identity(given: Any, made: gym.Env) -> Any:
    """What `digest_of` takes of an env.

    Args:
        given: the env, its id, or the function that makes it.
        made: the env, or one that was made of it.
    """
    found = layers(made)
    own = tuple(type(layer) for layer in found if not is_of_a_library(type(layer).__module__))
    if not isinstance(given, gym.Env):
        return (given, own) if own else given
    return (_of_spec(given.spec, bool(own)), tuple(map(_arguments, found)), own, _attributes(given, found))


def _of_spec(spec: Any, own: bool) -> Any:
    """The spec of an env as it was made; without the module of a user's class, which may be run or imported."""
    if spec is None:
        return None
    wrappers = [(one.name, dict(one.kwargs or {})) for one in spec.additional_wrappers]
    entry = spec.entry_point if isinstance(spec.entry_point, str) and not own else None
    return spec.id, entry, dict(spec.kwargs), spec.max_episode_steps, wrappers


def _arguments(layer: gym.Env) -> Any:
    """Name and recorded arguments of a wrapper of Gymnasium's or ours."""
    kept = getattr(layer, "_saved_kwargs", None)
    return type(layer).__qualname__, kept if isinstance(layer, gym.Wrapper) else None


def _attributes(env: gym.Env, found: list[gym.Env]) -> list[dict[str, str]]:
    """Digests of what the layers hold that is not of an episode: the same after resets with two seeds.

    Of this project's envs, and of wrappers of other packages, spec and arguments say all.
    """
    chosen = [one for one in found if not is_of_a_library(type(one).__module__) or _is_foreign_base(one)]
    if not chosen:
        return []
    generators, seen = GlobalGenerators(), []
    for seed in (0, 1):
        generators.seed(seed)
        try:
            with generators.used():
                env.reset(seed=seed)
        except Exception:  # it will say so when it makes the data
            return []
        seen.append([{name: digest_of(value) for name, value in _held(one).items()} for one in chosen])
    return [
        {name: text for name, text in one.items() if other.get(name) == text}
        for one, other in zip(*seen, strict=True)
    ]


def _is_foreign_base(layer: gym.Env) -> bool:
    return not isinstance(layer, gym.Wrapper) and not hasattr(layer, "plant_data")


def _held(layer: gym.Env) -> dict[str, Any]:
    hidden = {"env", "spec", "_np_random", "_np_random_seed", "_cached_spec", "_saved_kwargs"}
    return {name: value for name, value in held_by(layer).items() if name not in hidden}
