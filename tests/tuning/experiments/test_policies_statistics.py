"""Intervals over few training seeds: what they cover, and what they are in cases that a textbook has."""

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from scipy.stats import t as student
from scipy.stats import ttest_ind

from tuning.experiments.policies import EPISODES, Figure, as_interval, combined, mean_figure

SEEDS, EPISODE_COUNT = 5, 40
TRIALS = 1200


def figure(returns, source="a"):
    """The mean of returns (E, S), a column per training seed."""
    without = (returns.sum(axis=0) - returns) / (len(returns) - 1)
    return mean_figure(returns.mean(axis=0), without, source)


def returns_of(generator, episodes, level, spread, own, count=SEEDS):
    """Returns (E, S) of policies that differ by seed, on episodes that are harder or easier for all of them."""
    seeds, noise = generator.normal(0.0, spread, count), generator.normal(0.0, own, (len(episodes), count))
    return level * (1.0 + 0.2 * episodes[:, None]) + seeds + noise


def test_of_one_policy_on_the_same_episodes_it_is_students_interval():
    levels = np.array([-1.0, -1.1, -1.2, -1.3, -1.5])
    found = as_interval(figure(np.tile(levels, (EPISODE_COUNT, 1))))
    half = student.ppf(0.975, 4) * levels.std(ddof=1) / 5**0.5
    assert found == pytest.approx((levels.mean(), levels.mean() - half, levels.mean() + half))


def test_of_one_seed_it_is_students_interval_over_episodes():
    returns = np.random.default_rng(0).normal(-2.0, 0.5, (30, 1))
    found = as_interval(figure(returns))
    half = student.ppf(0.975, 29) * returns.std(ddof=1) / 30**0.5
    assert found == pytest.approx((returns.mean(), returns.mean() - half, returns.mean() + half))


def test_the_difference_of_two_policies_is_welchs():
    generator = np.random.default_rng(1)
    one, other = generator.normal(-1.0, 0.1, 5), generator.normal(-1.1, 0.4, 8)
    found = as_interval(figure(np.tile(one, (9, 1)), "one") - figure(np.tile(other, (9, 1)), "other"))
    expected = ttest_ind(one, other, equal_var=False).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))


def test_episodes_are_shared_and_seeds_are_not():
    hard = np.random.default_rng(0).normal(-5.0, 3.0, (50, 1))
    assert as_interval(figure(hard + 0.25, "a") - figure(hard, "b")) == pytest.approx((0.25, 0.25, 0.25))
    levels = np.tile([-1.0, -2.0, -3.0], (50, 1))
    same, tied = figure(levels, "a"), as_interval(figure(levels, "a") - figure(levels, "b"))
    assert as_interval(same - same) == pytest.approx((0, 0, 0)) and tied.high > 1.5 and tied.value == 0


def test_figures_combine_as_their_numbers_do():
    one, other = Figure(6.0, {EPISODES: np.array([6.0, 7.0])}), Figure(2.0, {"b": np.array([1.0, 2.0, 4.0])})
    ratio = combined(lambda a, b: a / b, one, other)
    assert ratio.value == 3.0 == (one / other).value
    np.testing.assert_array_equal(ratio.without[EPISODES], [3.0, 3.5])
    np.testing.assert_array_equal(ratio.without["b"], [6.0, 3.0, 1.5])


def covered(own):
    """The share of trials whose interval has the truth, for each question that a comparison asks, by name."""
    generator, hits = np.random.default_rng(7), {}
    for _ in range(TRIALS):
        episodes = generator.normal(size=EPISODE_COUNT)
        for name, truth, interval in questions(generator, episodes, own):
            hits[name] = hits.get(name, 0) + (interval[0] <= truth <= interval[1])
    return {name: count / TRIALS for name, count in hits.items()}


def questions(generator, episodes, own):
    raw, ekf, true = (
        figure(returns_of(generator, episodes, level, spread, own), name)
        for name, level, spread in (("raw", -6.0, 0.3), ("ekf", -0.72, 0.02), ("true", -0.5, 0.01))
    )
    best = figure(returns_of(generator, episodes, -0.45, 0.0, own, count=1))  # a controller: nothing was trained
    for name, truth, made in (
        ("one policy", -0.72, ekf),
        ("difference of two", -0.22, ekf - true),
        ("ratio of two", 1.44, ekf / true),
        ("ratio to a controller", 1.6, ekf / best),
        ("gap closed", (6.0 - 0.72) / (6.0 - 0.45), combined(lambda a, b, c: (a - b) / (c - b), ekf, raw, best)),
    ):
        found = as_interval(made)
        yield name, truth, (found.low, found.high)


def test_with_five_seeds_the_intervals_cover_what_they_promise():
    """95 %, to three standard errors of 1200 trials."""
    share = covered(own=0.03)
    assert len(share) == 5 and all(abs(found - 0.95) < 0.019 for found in share.values()), share


def test_where_a_policy_and_an_episode_do_not_add_up_the_intervals_are_rather_too_wide():
    """What a policy does in one episode and not in others is in both sources of chance."""
    share = covered(own=0.3)
    assert all(found > 0.935 for found in share.values()), share


def test_the_bootstrap_of_five_seeds_covers_less_than_it_promises():
    generator = np.random.default_rng(3)
    seeds = generator.normal(size=(2000, SEEDS))
    drawn = generator.integers(SEEDS, size=(400, SEEDS))
    low, high = np.quantile(seeds[:, drawn].mean(axis=2), [0.025, 0.975], axis=1)
    assert 0.80 < ((low <= 0) & (high >= 0)).mean() < 0.90
    means = [as_interval(figure(row[None].repeat(2, axis=0))) for row in seeds]
    assert 0.935 < np.mean([found.covers(0.0) for found in means]) < 0.965
