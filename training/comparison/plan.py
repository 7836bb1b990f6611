"""Which policies are compared, at which noise: a list of runs, each one training or one classical policy."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import numpy as np

from training.setup import Setup, make_setup
from tuning.plan import Plan
from tuning.scenarios import Scenario, find_scenario
from tuning.study import open_study, quiet_optuna, run_study

TASK = "manoeuvre"
NOISES = {"low": "low_noise", "medium": "medium_noise", "high": "high_noise"}  # names of scenarios
LEARNT = ("raw", "raw+action", "stack", "ekf", "enkf", "belief", "true")
FOR_PI = ("raw", "lowpass", "ekf", "enkf", "true")
FOR_LQR = ("lowpass", "kf", "ekf", "ukf", "enkf", "true")
VARIANT_NOISE = "medium"
TUNING_TRIALS = 60


class Comparison(NamedTuple):
    """How much is compared. The defaults are those of docs/policies.md."""

    noises: tuple[str, ...] = tuple(NOISES)
    arms: tuple[str, ...] = LEARNT
    seeds: int = 5  # of each learnt policy
    steps: int = 400_000  # that it learns from
    episodes: int = 200  # held out, the same for all
    variants: bool = True  # filters with a wrong model, tuned and untuned ones
    recurrent: bool = False  # PPO with memory of its own on raw measurements, which is slow


QUICK = Comparison(noises=("medium",), seeds=2, steps=8_192, episodes=16, variants=False)


class Run(NamedTuple):
    """One policy, trained with one seed."""

    noise: str
    kind: str  # "ppo", "recurrent-ppo", "pi" or "lqr"
    variant: str  # what is special about the filter, or nothing
    setup: Setup

    @property
    def label(self) -> str:
        """What it observes, and what is special about it."""
        return f"{self.setup.observe}, {self.variant}" if self.variant else self.setup.observe

    @property
    def name(self) -> str:
        """Name of its files."""
        words = [self.noise, self.kind, self.setup.observe, *self.variant.split(), f"seed{self.setup.seed}"]
        return "-".join(words).replace("+", "-and-")


def runs_of(comparison: Comparison) -> list[Run]:
    """All runs of a comparison; seed by seed, so that an early look has something of each arm."""
    classical = [
        _run(comparison, noise, kind, arm)
        for noise in comparison.noises
        for kind, arms in (("pi", FOR_PI), ("lqr", FOR_LQR))
        for arm in arms
    ]
    cases = [(noise, arm, "") for noise in comparison.noises for arm in comparison.arms]
    if comparison.variants:
        cases += [(VARIANT_NOISE, arm, variant) for arm, variant in VARIANTS]
    learnt = [
        _run(comparison, noise, "ppo", arm, variant, seed)
        for seed in range(comparison.seeds)
        for noise, arm, variant in cases
    ]
    recurrent = [
        _run(comparison, noise, "recurrent-ppo", "raw", "", seed)
        for seed in range(comparison.seeds if comparison.recurrent else 0)
        for noise in comparison.noises
    ]
    return classical + learnt + recurrent


VARIANTS = (
    ("ekf", "untuned"),
    ("ekf", "tuned"),
    ("ekf", "wrong model"),
    ("ekf", "wrong model tuned"),
    ("enkf", "wrong model"),
)


def _run(comparison: Comparison, noise: str, kind: str, arm: str, variant: str = "", seed: int = 0) -> Run:
    scenario = _scenario(noise, wrong=variant.startswith("wrong model"))
    arguments: Mapping = {}
    if variant.endswith("untuned"):
        arguments = scenario.untuned
    elif variant.endswith("tuned"):
        arguments = _tuned(arm, noise, variant.startswith("wrong model"))
    algo = kind if kind == "recurrent-ppo" else "ppo"
    setup = make_setup(
        TASK, scenario, arm, algo, steps=comparison.steps, seed=seed, filter_arguments=_plain(arguments)
    )
    return Run(noise, kind, variant, setup)


def _scenario(noise: str, wrong: bool) -> Scenario:
    """The scenario of a noise; with the wrong model of `mismatch` if asked for."""
    scenario = find_scenario(NOISES[noise])
    factors = find_scenario("mismatch").parameter_factors
    return scenario.replace(parameter_factors=factors) if wrong else scenario


@cache
def _tuned(filter_name: str, noise: str, wrong: bool) -> Mapping:
    """Q and R that a study finds on the noise's scenario, where voltages are held at random levels."""
    quiet_optuna()
    scenario = _scenario(noise, wrong)
    plan = Plan(filter_name, (scenario,))
    study = open_study("policies", plan, None)
    return run_study(study, plan, TUNING_TRIALS).or_interrupted().choice.model


def _plain(arguments: Mapping) -> dict:
    return {name: np.asarray(value).tolist() for name, value in arguments.items()}
