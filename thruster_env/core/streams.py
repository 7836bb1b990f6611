"""Randomness as a function: Philox4x32-10 keyed by an episode, indexed by stream, step and channel.

The same key gives the same numbers in a single env, a vector env, a batch and on any number of threads, because a
draw depends on its index only and never on earlier draws. Every expression works on scalars, on NumPy arrays and
in machine code. In order: the normal distribution, exponential, sine and cosine as vector code; the streams and
their draws; keys of episodes; the generators of foreign code.

Source: Salmon, Moraes, Dror, Shaw (2011), "Parallel random numbers: as easy as 1, 2, 3"; normals by Box and Muller
(1958).
"""

from __future__ import annotations

import copy
import math
import random
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np

from thruster_env.core.checks import options as checked_options
from thruster_env.core.checks import seed as checked_seed
from thruster_env.core.checks import short_repr

HALVINGS = 60  # of an interval of 80 standard deviations, to rounding


def below(z):
    """The normal distribution at z."""
    return 0.5 * math.erfc(-z / 2.0**0.5)


def quantile(share):
    """The z below which there is a share in (0, 1) of the normal distribution."""
    low, high = -40.0, 40.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if below(middle) < share:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


FAR = 5.0  # standard deviations, from which a continued fraction is used
VERY_FAR = 100.0  # from which the moments are series, whose next terms are 1e-10 of them
NEVER = -37.0  # beyond which exp(a^2/2) would not be finite; what lies below it has no probability
NARROW = 1e-4  # standard deviations, up to which the part is taken as uniform
TERMS = 60  # of the fraction


def mills_ratio(a):
    """(1 - Phi(a))/phi(a) of the standard normal distribution: the probability beyond a over the density at a."""
    if a < FAR:
        a = max(a, NEVER)
        return math.sqrt(0.5 * math.pi) * math.exp(0.5 * a * a) * math.erfc(a * math.sqrt(0.5))
    rest = a
    for k in range(TERMS, 0, -1):
        rest = a + k / rest
    return 1.0 / rest


def truncated_normal(low, high):
    """Mean and variance of a standard normal variable truncated to two bounds, one of which may be infinite.

        d = m(a) - e m(b),  e = exp((a^2 - b^2)/2),  mean = (1 - e)/d,  variance = 1 + (a - b e)/d - mean^2

    with Mills' ratio m, in the order in which b >= |a|; with e = 0 for one bound.

    Source: Johnson, Kotz, Balakrishnan (1994), Continuous Univariate Distributions, volume 1, section 13.10.1.
    """
    sign, a, b = 1.0, low, high
    if low + high < 0.0:
        sign, a, b = -1.0, -high, -low
    if b - a < NARROW:
        return sign * 0.5 * (a + b), (b - a) * (b - a) / 12.0
    e = math.exp(-0.5 * (b - a) * (b + a)) if b < math.inf else 0.0
    if a > VERY_FAR and e < 1e-16:
        s = 1.0 / (a * a)
        return sign * (a + (1.0 - s * (2.0 - 10.0 * s)) / a), s * (1.0 - s * (6.0 - 50.0 * s))
    d, end = mills_ratio(a), a
    if e > 0.0:
        d, end = d - e * mills_ratio(b), a - b * e
    mean = (1.0 - e) / d
    return sign * mean, max(1.0 + end / d - mean * mean, 0.0)


LOWEST = -46.0  # e^-46 = 1e-20 is nothing beside 1, and still tells how far the others are off
LN_2, PER_LN_2 = math.log(2.0), 1.0 / math.log(2.0)
ROUNDER = 1.5 * 2.0**52  # adding it leaves a whole number in the last bits
ROUNDER_BITS = int(np.float64(ROUNDER).view(np.int64))


def parts(x):
    """The factor e^r and the power k of e^x = e^r 2^k, |r| <= log(2)/2, by its series, to 1e-16."""
    k = np.floor(x * PER_LN_2 + 0.5)
    r = x - k * LN_2
    series = 1.0 / 6227020800.0
    series = series * r + 1.0 / 479001600.0
    series = series * r + 1.0 / 39916800.0
    series = series * r + 1.0 / 3628800.0
    series = series * r + 1.0 / 362880.0
    series = series * r + 1.0 / 40320.0
    series = series * r + 1.0 / 5040.0
    series = series * r + 1.0 / 720.0
    series = series * r + 1.0 / 120.0
    series = series * r + 1.0 / 24.0
    series = series * r + 1.0 / 6.0
    series = series * r + 0.5
    series = series * r + 1.0
    series = series * r + 1.0
    return series, k


def exponential(x):
    """e^x for x <= 700, as e^-46 below -46 and for NaN."""
    series, k = parts(x if x > LOWEST else LOWEST)
    bits = np.float64(k + ROUNDER).view(np.int64) - ROUNDER_BITS  # k itself, which becomes the exponent
    return series * np.int64((bits + 1023) << 52).view(np.float64)


_PI, _PER_TURN = math.pi, 0.5 / math.pi


def cosine_and_sine_of_turns(turns):
    """cos(2 pi turns) and sin(2 pi turns) for |turns| <= 1/2: Taylor series at half the angle, doubled."""
    a = _PI * turns
    q = a * a
    s = -1.0 / 121645100408832000.0
    s = s * q + 1.0 / 355687428096000.0
    s = s * q - 1.0 / 1307674368000.0
    s = s * q + 1.0 / 6227020800.0
    s = s * q - 1.0 / 39916800.0
    s = s * q + 1.0 / 362880.0
    s = s * q - 1.0 / 5040.0
    s = s * q + 1.0 / 120.0
    s = s * q - 1.0 / 6.0
    s = (s * q + 1.0) * a
    c = -1.0 / 6402373705728000.0
    c = c * q + 1.0 / 20922789888000.0
    c = c * q - 1.0 / 87178291200.0
    c = c * q + 1.0 / 479001600.0
    c = c * q - 1.0 / 3628800.0
    c = c * q + 1.0 / 40320.0
    c = c * q - 1.0 / 720.0
    c = c * q + 1.0 / 24.0
    c = c * q - 0.5
    c = c * q + 1.0
    return 1.0 - 2.0 * s * s, 2.0 * s * c


def nearest_whole(x):
    """The whole number nearest to x, of a float, an array or a tensor; one instruction in compiled code.

    It uses a remainder, because torch knows its derivative, but not that of a floor.
    """
    above = x + 0.5
    return above - above % 1.0


def cosine_and_sine(angle):
    """The cosine and sine of any angle [rad], of a float, an array or a tensor.

    Errors are some 2e-16 up to a right angle, and at most 1e-14 up to two turns.
    """
    turns = _PER_TURN * angle
    return cosine_and_sine_of_turns(turns - nearest_whole(turns))


# Streams: what a draw is for. Two streams of one key are independent.
PROCESS, MEASUREMENT, INITIAL, EXCITATION, FILTER_PROCESS, FILTER_MEASUREMENT, FILTER_PRIOR = range(1, 8)
DISTURBANCE, CHANCE, REFERENCE_SIGNAL, PARAMETERS, FILTER_ROTATION, FILTER_KERNEL = range(8, 14)
ADDED_NOISE = 14  # of a problem, to measurements whose own noise an env may have drawn from the same key
FILTER_PROPOSAL = 24  # behind the spawn keys

# Spawn keys: what a generator of a seed is for. An env's own is that without one, `default_rng(seed)`, and so is
# that of the list [seed, 0]. They go on where streams end, for the keys of filters have the number of theirs.
RANDOM_ACTIONS, ACTION_SPACE, POLICY, GLOBAL_GENERATORS, HELD_GENERATORS = range(15, 20)
START_POINTS, COMPARISON_STUDY, LOCAL_TRIALS, METHOD_OF_TUNING = range(20, 24)
SPAWN_KEYS = {
    "filter": FILTER_PRIOR,
    "random actions": RANDOM_ACTIONS,
    "action space": ACTION_SPACE,
    "policy": POLICY,
    "global generators": GLOBAL_GENERATORS,
    "held generators": HELD_GENERATORS,
    "start points": START_POINTS,
    "comparison study": COMPARISON_STUDY,
    "local trials": LOCAL_TRIALS,
    "method of tuning": METHOD_OF_TUNING,
}

GROUP = 32  # normals that one pass of vector code makes: four from each of eight blocks
AT_ONCE = 512  # blocks that Python draws in one pass

_MULTIPLIER_0, _MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_WEYL_0, _WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_LOW, _SHIFT, _NONE = np.uint64(0xFFFFFFFF), np.uint64(32), np.uint64(0)
SQRT_HALF_BITS = int(np.float64(np.sqrt(0.5)).view(np.int64))
_LN_2, _TWO_TO_MINUS_32 = float(np.log(2.0)), 2.0**-32


def _round(counter, key):
    # Of each word the low 32 bits count. What lies above them is taken off where it would matter, before a
    # product: there it costs nothing, for vector code multiplies the lower halves of 64 bits anyway.
    c0, c1, c2, c3 = counter
    product_0 = _MULTIPLIER_0 * (c0 & _LOW)
    product_1 = _MULTIPLIER_1 * (c2 & _LOW)
    return (product_1 >> _SHIFT) ^ c1 ^ key[0], product_1, (product_0 >> _SHIFT) ^ c3 ^ key[1], product_0


def _bump(key):
    return (key[0] + _WEYL_0) & _LOW, (key[1] + _WEYL_1) & _LOW


def philox(counter, key):
    """Four 32-bit words, held in uint64, from a counter of four words and a key of two.

    Ten rounds, written out: a loop here would keep the compiler from vectorising the caller's loop.
    """
    key_1 = _bump(key)
    key_2 = _bump(key_1)
    key_3 = _bump(key_2)
    key_4 = _bump(key_3)
    counter = _round(_round(_round(_round(_round(counter, key), key_1), key_2), key_3), key_4)
    key_5 = _bump(key_4)
    key_6 = _bump(key_5)
    key_7 = _bump(key_6)
    key_8 = _bump(key_7)
    w0, w1, w2, w3 = _round(_round(_round(_round(_round(counter, key_5), key_6), key_7), key_8), _bump(key_8))
    return w0 & _LOW, w1 & _LOW, w2 & _LOW, w3 & _LOW


def uniform_block(block, step, stream, key_0, key_1):
    """Four uniform numbers in (0, 1), multiples of 2^-32 plus 2^-33, for one block of one step."""
    counter = (np.uint64(block), np.uint64(step), np.uint64(stream), _NONE)
    w0, w1, w2, w3 = philox(counter, (np.uint64(key_0), np.uint64(key_1)))
    return (
        (np.float64(np.int64(w0)) + 0.5) * _TWO_TO_MINUS_32,
        (np.float64(np.int64(w1)) + 0.5) * _TWO_TO_MINUS_32,
        (np.float64(np.int64(w2)) + 0.5) * _TWO_TO_MINUS_32,
        (np.float64(np.int64(w3)) + 0.5) * _TWO_TO_MINUS_32,
    )


def logarithm_of_parts(exponent, m):
    """The logarithm of 2^exponent m, m in [sqrt(1/2), sqrt(2)): log m = 2 artanh((m - 1)/(m + 1)), a series."""
    s = (m - 1.0) / (m + 1.0)
    t = s * s
    series = 1.0 / 21.0
    series = series * t + 1.0 / 19.0
    series = series * t + 1.0 / 17.0
    series = series * t + 1.0 / 15.0
    series = series * t + 1.0 / 13.0
    series = series * t + 1.0 / 11.0
    series = series * t + 1.0 / 9.0
    series = series * t + 1.0 / 7.0
    series = series * t + 1.0 / 5.0
    series = series * t + 1.0 / 3.0
    series = series * t + 1.0
    return exponent * _LN_2 + 2.0 * s * series


def exponent_and_mantissa(x):
    """The exponent e and the mantissa m of x = 2^e m, m in [sqrt(1/2), sqrt(2)), of positive, normal float64."""
    bits = np.float64(x).view(np.int64)
    exponent = (bits - SQRT_HALF_BITS) >> 52
    return np.float64(exponent), np.int64(bits - (exponent << 52)).view(np.float64)


def logarithm(x):
    """Natural logarithm of a positive, normal float64 to 1e-15, without a branch or a library call."""
    exponent, m = exponent_and_mantissa(x)
    return logarithm_of_parts(exponent, m)


def polar(log_0, u_1, log_2, u_3):
    """Four standard normals of uniform numbers, of which two are given by their logarithms (Box, Muller)."""
    radius_0, radius_1 = (-2.0 * log_0) ** 0.5, (-2.0 * log_2) ** 0.5
    cosine_0, sine_0 = cosine_and_sine_of_turns(u_1 - 0.5)
    cosine_1, sine_1 = cosine_and_sine_of_turns(u_3 - 0.5)
    return radius_0 * cosine_0, radius_0 * sine_0, radius_1 * cosine_1, radius_1 * sine_1


def normal_block(block, step, stream, key_0, key_1):
    """Four independent standard normals (|value| < 6.8) for one block of one step of one stream."""
    u0, u1, u2, u3 = uniform_block(block, step, stream, key_0, key_1)
    return polar(logarithm(u0), u1, logarithm(u2), u3)


def fill_normals(out, count, step, stream, key_0, key_1):
    """Fill a vector with the normals of channels 0, 1, 2, ..., at least `count` of them.

    It fills whole groups of GROUP, so that the compiled loop has no remainder; out must have room for them. In
    Python it draws the normals of several steps at once, which takes about as long as one step's.
    """
    if out.dtype != np.float64:  # numbers that count what is done to them
        return fill_in_loop(out, count, step, stream, key_0, key_1)
    blocks = (count + GROUP - 1) // GROUP * (GROUP // 4)
    steps_at_once = max(AT_ONCE // max(blocks, 1), 1)
    rows = _normals_of_steps(blocks, step // steps_at_once, steps_at_once, stream, key_0, key_1)
    out[: 4 * blocks] = rows[int(step % steps_at_once)]


@lru_cache(maxsize=32)
def _normals_of_steps(blocks, begin, count, stream, key_0, key_1):
    """Normals (count, 4 blocks) of `count` steps from step begin * count on."""
    steps = begin * count + np.arange(count)[:, None]
    return np.stack(normal_block(np.arange(blocks), steps, stream, key_0, key_1), axis=-1).reshape(count, -1)


def fill_in_loop(out, count, step, stream, key_0, key_1):
    """`fill_normals`, block after block."""
    for block in range((count + GROUP - 1) // GROUP * (GROUP // 4)):
        z0, z1, z2, z3 = normal_block(block, step, stream, key_0, key_1)
        out[4 * block] = z0
        out[4 * block + 1] = z1
        out[4 * block + 2] = z2
        out[4 * block + 3] = z3


def draw_key(generator: np.random.Generator) -> np.ndarray:
    """Draw an episode's key from a NumPy generator: two 32-bit words as float64, shape (2,)."""
    return generator.integers(0, 2**32, size=2).astype(np.float64)


def draw_keys(generator: np.random.Generator, count: int) -> np.ndarray:
    """Draw keys (count, 2): those that `count` calls of `draw_key` would give."""
    return generator.integers(0, 2**32, size=(count, 2)).astype(np.float64)


def episode_keys(seeds) -> np.ndarray:
    """Keys, shape (len(seeds), 2), that envs draw at their first `reset(seed=s)` for s in seeds."""
    from gymnasium.utils.seeding import np_random

    return np.array([draw_key(np_random(int(seed))[0]) for seed in seeds])


def derived_sequence(seed: int | None, purpose: int, *numbers: int) -> np.random.SeedSequence:
    """The seed sequence of one purpose: independent of the env's own, and of that of every other purpose.

    Args:
        seed: of the env, the problem or the study.
        purpose: one of SPAWN_KEYS.
        *numbers: which of several it is, such as the number of a case.
    """
    return np.random.SeedSequence(seed, spawn_key=(purpose, *numbers))


def derived_generator(seed: int | None, purpose: int, *numbers: int) -> np.random.Generator:
    """A generator of one purpose; see `derived_sequence`."""
    return np.random.default_rng(derived_sequence(seed, purpose, *numbers))


def derived_seed(seed: int | None, purpose: int, *numbers: int) -> int:
    """A whole number below 2^32 for code that takes a seed and no generator; see `derived_sequence`."""
    return int(derived_sequence(seed, purpose, *numbers).generate_state(1)[0])


def filter_generator(seed: int | None) -> np.random.Generator:
    """Generator of the keys that a filter wrapper draws, one an episode, after `reset(seed=seed)`."""
    return derived_generator(seed, FILTER_PRIOR)


def filter_keys(seeds) -> np.ndarray:
    """Keys, shape (len(seeds), 2), of a filter wrapper's first episode after `reset(seed=s)` for s in seeds."""
    return np.array([draw_key(filter_generator(int(seed))) for seed in seeds])


KEYS_AHEAD = 16  # that a copy draws at a time: a call of its generator costs more than a step


def _of_env(seed: int | None) -> np.random.Generator:
    from gymnasium.utils.seeding import np_random

    return np_random(seed)[0]


class EpisodeKeys:
    """The keys that each copy's own generator draws, one an episode."""

    def __init__(self, count: int, make_generator: Callable[[int | None], np.random.Generator] = _of_env):
        self._make_generator = make_generator
        self._generators: list[np.random.Generator | None] = [None] * count
        self._ahead = np.zeros((count, KEYS_AHEAD, 2))
        self._used = np.full(count, KEYS_AHEAD)
        self.seeded = False  # whether all copies have generators: asked at every step, so it is remembered

    @property
    def count(self) -> int:
        """Number of copies."""
        return len(self._generators)

    def seed(self, seed: int | list[int | None] | None, mask: np.ndarray) -> None:
        """Give copy i of those in the mask a generator from seed + i, or seed[i]; None keeps the one it has."""
        seeds = self.seeds(seed)
        for i in np.flatnonzero(mask):
            if seeds[i] is not None or self._generators[i] is None:
                self._generators[i] = self._make_generator(seeds[i])
                self._used[i] = KEYS_AHEAD
        self.seeded = None not in self._generators

    def seeds(self, seed) -> list[int | None]:
        """The seed of each copy; ValueError unless a reset's seed is None, a number, or one of these a copy."""
        count = self.count
        if isinstance(seed, (list, tuple)) or (isinstance(seed, np.ndarray) and seed.ndim == 1):
            if len(seed) != count:
                raise ValueError(f"seed must be None, a number or {count} of these, but got {short_repr(seed)}")
            return [checked_seed(entry) for entry in seed]
        first = checked_seed(seed)
        return [None if first is None else first + i for i in range(count)]

    def draw(self, which: np.ndarray) -> np.ndarray:
        """The next key (len(which), 2) of some copies."""
        for i in which[self._used[which] == KEYS_AHEAD]:
            self._ahead[i] = draw_keys(self._generators[i], KEYS_AHEAD)
            self._used[i] = 0
        keys = self._ahead[which, self._used[which]]
        self._used[which] += 1
        return keys


def reset_mask(options: Mapping | None, keys: EpisodeKeys) -> np.ndarray | None:
    """The copies that a reset's options restart, (count,) booleans; None for all.

    Raises ValueError for other options, and for a mask that leaves out copies that have never been reset.
    """
    mask, count = checked_options(options).get("reset_mask"), keys.count
    if mask is None:
        return None
    try:
        chosen = np.asarray(mask)
    except ValueError:  # rows of different lengths
        chosen = np.empty(0)
    if chosen.shape != (count,) or chosen.dtype != np.bool_ or not chosen.any():
        rule = f"reset_mask must be {count} booleans, at least one of them true"
        raise ValueError(f"{rule}, but got {short_repr(mask)}")
    if not keys.seeded and not chosen.all():
        raise ValueError(f"reset_mask must have all copies at the first reset, but got {short_repr(mask)}")
    return chosen.copy()


HELD = (np.random.Generator, np.random.RandomState, random.Random)


class GlobalGenerators:
    """The global generators' states for one owner, unaffected by draws of others in between.

    Before `seed`, `used` leaves them alone. torch is seeded where it has been imported by then, on the CPU.
    """

    def __init__(self):
        self._states: tuple | None = None
        self._within = False

    def seed(self, seed: int) -> None:
        """Start from a seed below 2^32; the global generators stay as they are."""
        before = _states()
        random.seed(seed)
        np.random.seed(seed)
        torch = _torch()
        if torch is not None:
            torch.default_generator.manual_seed(seed)
        self._states = _states()
        if not self._within:
            _set(before)

    @contextmanager
    def used(self) -> Iterator[None]:
        """Within this context the global generators are the owner's; afterwards they are as before."""
        if self._within or self._states is None:
            yield
            return
        before, self._within = _states(), True
        _set(self._states)
        try:
            yield
        finally:
            self._states, self._within = _states(), False
            _set(before)

    def __deepcopy__(self, memo) -> GlobalGenerators:
        """An independent copy; states may be shared because they are never written into."""
        other = GlobalGenerators()
        other._states = self._states
        return other


def _torch() -> Any:
    torch: Any = sys.modules.get("torch")
    return torch if hasattr(torch, "default_generator") else None


def _states() -> tuple:
    torch = _torch()
    return random.getstate(), np.random.get_state(), None if torch is None else torch.get_rng_state()


def _set(states: tuple) -> None:
    pythons, numpys, torchs = states
    random.setstate(pythons)
    np.random.set_state(numpys)
    torch = _torch()
    if torchs is not None and torch is not None:
        torch.set_rng_state(torchs)


def seeded_copy(original: Any, seed: int) -> Any:
    """A deep copy of an object, in which each generator of Python and NumPy gets a new seed."""
    memo: dict = {}
    duplicate = copy.deepcopy(original, memo)
    generators = (part for part in memo.values() if isinstance(part, HELD))
    for number, generator in enumerate({id(generator): generator for generator in generators}.values()):
        generator_seed = derived_seed(seed, HELD_GENERATORS, number)
        if isinstance(generator, np.random.Generator):
            kind: Any = type(generator.bit_generator)
            generator.bit_generator.state = kind(generator_seed).state
        else:
            generator.seed(generator_seed)
    return duplicate
