import math
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.seeding import np_random
from scipy import stats

import thruster_env  # noqa: F401 - registers the env
from thruster_env.core import streams
from thruster_env.graphs.loops import Loops

BLOCKS = 1_000_000  # four normals each
KEY = (123456789.0, 987654321.0)

# Known answers of Random123 1.14 for philox4x32-10: counter, key, words.
KNOWN = [
    (
        (0x00000000, 0x00000000, 0x00000000, 0x00000000),
        (0x00000000, 0x00000000),
        (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8),
    ),
    (
        (0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF),
        (0xFFFFFFFF, 0xFFFFFFFF),
        (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD),
    ),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]


@pytest.fixture(scope="module")
def normals():
    return np.array(streams.normal_block(0, np.arange(BLOCKS), streams.PROCESS, *KEY))


@pytest.mark.parametrize(("counter", "key", "words"), KNOWN)
def test_philox_gives_the_known_answers(counter, key, words):
    assert streams.philox(tuple(map(np.uint64, counter)), tuple(map(np.uint64, key))) == words


def test_philox_gives_the_known_answers_on_arrays():
    counters, keys, words = (np.array(column, dtype=np.uint64).T for column in zip(*KNOWN, strict=True))
    np.testing.assert_array_equal(streams.philox(tuple(counters), tuple(keys)), words)


def test_counter_is_block_step_stream_and_zero():
    counter = tuple(map(np.uint64, (7, 8, 3, 0)))
    words = streams.philox(counter, (np.uint64(5), np.uint64(4294967295)))
    uniforms = streams.uniform_block(7, 8.0, 3, 5.0, 4294967295.0)
    assert uniforms == tuple((int(word) + 0.5) / 2**32 for word in words)


def test_logarithm_agrees_with_the_library():
    u = np.concatenate([np.logspace(-300, 300, 20_001), np.linspace(2.0**-33, 1 - 2.0**-33, 20_000)])
    u = u[u != 1.0]
    expected = np.array([math.log(value) for value in u])
    np.testing.assert_allclose(streams.logarithm(u), expected, rtol=1e-15, atol=0)
    assert streams.logarithm(1.0) == 0.0


def test_cosine_and_sine_agree_with_the_library():
    turns = np.linspace(-0.5, 0.5, 20_001)
    cosine, sine = streams.cosine_and_sine_of_turns(turns)
    np.testing.assert_allclose(cosine, [math.cos(2 * math.pi * t) for t in turns], rtol=0, atol=1e-14)
    np.testing.assert_allclose(sine, [math.sin(2 * math.pi * t) for t in turns], rtol=0, atol=1e-14)


@pytest.mark.parametrize("word", [0, 2**32 - 1])
def test_extreme_words_give_finite_normals(word, monkeypatch):
    monkeypatch.setattr(streams, "philox", lambda counter, key: (np.uint64(word),) * 4)
    assert all(0.0 < u < 1.0 for u in streams.uniform_block(0, 0, 1, *KEY))
    assert all(abs(z) < 6.8 for z in streams.normal_block(0, 0, 1, *KEY))


def test_normals_are_box_and_mullers():
    u0, u1, u2, u3 = streams.uniform_block(3, 17, streams.INITIAL, *KEY)
    expected = []
    for a, b in ((u0, u1), (u2, u3)):
        radius, angle = math.sqrt(-2 * math.log(a)), 2 * math.pi * (b - 0.5)
        expected += [radius * math.cos(angle), radius * math.sin(angle)]
    np.testing.assert_allclose(streams.normal_block(3, 17, streams.INITIAL, *KEY), expected, atol=1e-13)


# The bounds below are five standard errors: a right generator fails one of them with probability 6e-7.
def test_moments_are_those_of_a_normal(normals):
    for z in (*normals, normals.ravel()):
        n = z.size
        assert abs(z.mean()) < 5 / math.sqrt(n)
        assert abs((z**2).mean() - 1) < 5 * math.sqrt(2 / n)
        assert abs((z**3).mean()) < 5 * math.sqrt(15 / n)
        assert abs((z**4).mean() - 3) < 5 * math.sqrt(96 / n)


def test_distribution_is_normal(normals):
    assert stats.kstest(normals.ravel(), "norm").pvalue > 6e-7


@pytest.mark.parametrize("bound", [-4, -3, -1, 0, 1, 3, 4])
def test_tails_have_the_right_weight(normals, bound):
    n, p = normals.size, stats.norm.cdf(bound)
    assert abs((normals < bound).sum() - n * p) < 5 * math.sqrt(n * p * (1 - p))


PLAIN = {"block": 0, "shift": 0, "stream": streams.PROCESS, "key": KEY}
NEIGHBOURS = {
    "channels": [{}],
    "steps": [{}, {"shift": 1}],
    "blocks": [{}, {"block": 1}],
    "streams": [{"stream": stream} for stream in (1, 2, 3)],
    "keys": [{}, {"key": (KEY[0] + 1, KEY[1])}, {"key": (KEY[0], KEY[1] + 1)}],
    "swapped keys": [{}, {"key": KEY[::-1]}],
}


@pytest.mark.parametrize("changes", NEIGHBOURS.values(), ids=NEIGHBOURS.keys())
def test_neighbours_are_independent(changes):
    steps, draws = np.arange(BLOCKS // 5), []
    for change in changes:
        at = PLAIN | change
        draws.extend(streams.normal_block(at["block"], steps + at["shift"], at["stream"], *at["key"]))
    for values in (np.array(draws), np.square(draws)):  # the squares would show a shared radius
        correlation = np.corrcoef(values)
        np.fill_diagonal(correlation, 0.0)
        assert np.abs(correlation).max() < 5.5 / math.sqrt(steps.size)


def test_arrays_and_scalars_give_the_same_numbers():
    steps = np.arange(20)
    many = np.array(streams.normal_block(2, steps, streams.MEASUREMENT, *KEY))
    for step in steps:
        one = streams.normal_block(2, float(step), streams.MEASUREMENT, *KEY)
        np.testing.assert_allclose(one, many[:, step], rtol=0, atol=1e-12)


@pytest.mark.parametrize("step", [5, 64, 1000.0])
@pytest.mark.parametrize("count", [1, 31, 32, 33, 64])
def test_channels_are_filled_in_the_order_of_the_blocks(count, step):
    out = np.full(96, np.nan)
    streams.fill_normals(out, count, step, streams.FILTER_PROCESS, *KEY)
    filled = -(-count // streams.GROUP) * streams.GROUP
    blocks = np.stack(streams.normal_block(np.arange(filled // 4), step, streams.FILTER_PROCESS, *KEY), axis=-1)
    np.testing.assert_array_equal(out[:filled], np.ravel(blocks))
    assert np.isnan(out[filled:]).all()


def test_compiled_normals_are_the_interpreted_ones():

    def fill(out, count, key_0, key_1):
        for step in range(out.shape[0]):
            streams_fill(out[step], count, step, 3, key_0, key_1)

    streams_fill = streams.fill_normals
    for key in (KEY, (0.0, 0.0), (4294967295.0, 4294967295.0)):
        expected, out = np.empty((20, 64)), np.empty((20, 64))
        fill(expected, 64, *key)
        Loops(fill)(out, 64, *key)
        np.testing.assert_allclose(out, expected, rtol=0, atol=1e-12)


def test_keys_are_pairs_of_32_bit_words():
    keys = streams.episode_keys(range(200))
    assert keys.shape == (200, 2) and keys.dtype == np.float64
    assert (keys == np.floor(keys)).all() and keys.min() >= 0 and keys.max() < 2**32
    assert len(np.unique(keys)) == 400


def test_episode_keys_are_what_the_env_draws_at_a_seeded_reset():
    for seed in (0, 1, 12345, 2**40):
        np.testing.assert_array_equal(streams.episode_keys([seed])[0], streams.draw_key(np_random(seed)[0]))


def test_filter_keys_are_reproducible_and_not_the_episodes():
    seeds = range(50)
    keys = streams.filter_keys(seeds)
    np.testing.assert_array_equal(keys, streams.filter_keys(seeds))
    np.testing.assert_array_equal(keys[7], streams.draw_key(streams.filter_generator(7)))
    assert len(np.unique(np.concatenate([keys, streams.episode_keys(seeds)]))) == 200


def test_without_a_seed_two_filters_draw_different_keys():
    first, second = (streams.draw_key(streams.filter_generator(None)) for _ in range(2))
    assert (first != second).all()


def largest_correlation(parts):
    """The largest correlation, without its sign, of two of some rows of draws."""
    found = np.corrcoef(parts)
    np.fill_diagonal(found, 0.0)
    return np.abs(found).max()


def test_each_pair_of_generators_of_a_seed_and_its_neighbours_is_uncorrelated():
    """Level 1e-4 in all: some 400 pairs of 4000 draws. Copy i of a vector env has the seed s + i."""
    seeds, count, rows = (3, 4), 4000, {}
    for seed in seeds:
        rows["env", seed] = np_random(seed)[0].uniform(size=count)
        space = gym.spaces.Box(0.0, 1.0, (1,), np.float64)
        space.seed(streams.derived_seed(seed, streams.ACTION_SPACE))
        rows["sampled", seed] = np.array([space.sample()[0] for _ in range(count)])
        for purpose, key in streams.SPAWN_KEYS.items():
            rows[purpose, seed] = streams.derived_generator(seed, key).uniform(size=count)
        rows["numbered", seed] = streams.derived_generator(seed, streams.COMPARISON_STUDY, 0).uniform(size=count)
    assert len(set(streams.SPAWN_KEYS.values())) == len(streams.SPAWN_KEYS) == 10
    assert largest_correlation(np.array(list(rows.values()))) < 5.1 / np.sqrt(count)


def test_an_env_seeded_like_its_action_space_would_be_that_space():
    """Why a stream has a spawn key: these are the same numbers."""
    space = gym.spaces.Box(0.0, 1.0, (1,), np.float64)
    space.seed(3)
    assert space.sample()[0] == np_random(3)[0].uniform() == np.random.default_rng([3, 0]).uniform()


def test_each_pair_of_philox_streams_of_a_key_is_uncorrelated():
    names = [name for name in vars(streams) if name.isupper() and isinstance(getattr(streams, name), int)]
    numbers = {getattr(streams, name) for name in names if 1 <= getattr(streams, name) <= streams.ADDED_NOISE}
    assert numbers == set(range(1, 15))
    steps = np.arange(1000)
    rows = [np.ravel(streams.normal_block(0, steps, one, 12345.0, 678.0)) for one in sorted(numbers)]
    assert largest_correlation(np.array(rows)) < 5.0 / np.sqrt(4000)


def test_streams_of_a_seed_are_derived_in_one_place():
    """No list of seed and index makes a generator but where a run has no other one of its seed.

    These are the seeds of Optuna's samplers, which have generators of another kind, the keys of the vehicle's
    published paths, and the targets of OKF's lidar.
    """
    root = Path(streams.__file__).parents[2]
    packages = ("thruster_env", "filters", "tuning")
    for path in (path for package in packages for path in (root / package).rglob("*.py")):
        if path.name not in ("streams.py", "trials.py", "vehicle_runs.py", "lidar.py"):
            text = path.read_text(encoding="utf-8")
            assert "SeedSequence(" not in text and "default_rng([" not in text, path
