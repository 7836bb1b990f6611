"""Which policies are compared, at which noise: a list of runs, each one training or one classical policy.

Beside the three noises, all at medium noise: filters with other Q and R (`untuned`, `tuned`), and three situations
in which filter and controller believe in a model that is wrong (`WRONG`). A policy learns in the situation itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import numpy as np

from training.setup import Setup, make_setup
from tuning.search.plan import Plan
from tuning.search.study import open_study, quiet_optuna, run_study
from tuning.thruster.find import find_scenario
from tuning.thruster.scenario import Scenario

TASK = "manoeuvre"
NOISES = {"low": "low_noise", "medium": "medium_noise", "high": "high_noise"}  # names of scenarios
LEARNT = ("raw", "raw+action", "stack", "ekf", "enkf", "belief", "true")
FOR_PI = ("raw", "lowpass", "ekf", "enkf", "true")
FOR_STATES = ("lowpass", "kf", "ekf", "ukf", "enkf", "true")
CLASSICAL = {"pi": FOR_PI, "lqr": FOR_STATES, "one-step": FOR_STATES, "mpc": FOR_STATES}
BEST = (
    "mpc"  # the best controller known: on the true state what "gap closed" is measured to, and what is corrected
)
CORRECTING = {"ppo+mpc": "ppo", "sac+mpc": "sac"}  # kinds that correct it, and the algorithm
OF_MEDIUM = {"sac": ("ekf", "true"), "ppo+mpc": ("true",), "sac+mpc": ("ekf", "true")}  # at medium noise only
VARIANT_NOISE = "medium"
WRONG = {
    "wrong model": "mismatch",
    "dead band": "deadband",
    "unknown flow": "ambient",
}  # and the scenario it is of
VARIANTS = (
    ("ekf", "untuned"),
    ("ekf", "tuned"),
    ("ekf", "wrong model"),
    ("ekf", "wrong model tuned"),
    ("enkf", "wrong model"),
    ("ekf", "dead band"),
    ("ekf", "unknown flow"),
)
TUNING_TRIALS = 60


class Comparison(NamedTuple):
    """How much is compared. The defaults are those of docs/policies.md."""

    noises: tuple[str, ...] = tuple(NOISES)
    arms: tuple[str, ...] = LEARNT
    seeds: int = 5  # of each learnt policy
    steps: int | None = None  # that it learns from; None for what its algorithm takes
    episodes: int = 200  # held out, the same for all
    variants: bool = True  # filters with other Q and R, and wrong models
    recurrent: bool = False  # PPO with memory of its own on raw measurements, which is slow


QUICK = Comparison(noises=("medium",), seeds=2, steps=8_192, episodes=16, variants=False)


class Run(NamedTuple):
    """One policy, trained with one seed."""

    noise: str
    kind: str  # an algorithm, one of `CORRECTING`, or a controller of `CLASSICAL`
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
    variants = VARIANTS if comparison.variants else ()
    cases = [
        (noise, kind, arm, "") for noise in comparison.noises for kind in CLASSICAL for arm in CLASSICAL[kind]
    ]
    cases += [(VARIANT_NOISE, BEST, arm, variant) for arm, variant in variants]
    cases += [(VARIANT_NOISE, BEST, "true", variant) for variant in WRONG if variants and variant != "wrong model"]
    classical = [_run(comparison, *case) for case in cases]
    return classical + [
        _run(comparison, *case, seed) for seed in range(comparison.seeds) for case in _learnt(comparison)
    ]


def _learnt(comparison: Comparison) -> list[tuple[str, str, str, str]]:
    """Noise, kind, arm and variant of what is learnt."""
    cases = []
    for noise in comparison.noises:
        cases += [(noise, "ppo", arm, "") for arm in comparison.arms]
        cases.append((noise, "ppo+mpc", "ekf", ""))
        if noise == VARIANT_NOISE:
            cases += [(noise, kind, arm, "") for kind, arms in OF_MEDIUM.items() for arm in arms]
        if comparison.recurrent:
            cases.append((noise, "recurrent-ppo", "raw", ""))
    if comparison.variants:
        cases += [(VARIANT_NOISE, "ppo", arm, variant) for arm, variant in VARIANTS]
        cases += [(VARIANT_NOISE, "ppo+mpc", "ekf", variant) for variant in WRONG]
    return cases


def _run(comparison: Comparison, noise: str, kind: str, arm: str, variant: str = "", seed: int = 0) -> Run:
    scenario = _scenario(noise, variant)
    arguments: Mapping = {}
    if variant.endswith("untuned"):
        arguments = scenario.untuned
    elif variant.endswith("tuned"):
        arguments = _tuned(arm, noise, variant)
    algo = "ppo" if kind in CLASSICAL else CORRECTING.get(kind, kind)
    setup = make_setup(
        TASK,
        scenario,
        arm,
        algo,
        steps=comparison.steps,
        seed=seed,
        filter_arguments=_plain(arguments),
        controller=BEST if kind in CORRECTING else None,
    )
    return Run(noise, kind, variant, setup)


def _scenario(noise: str, variant: str) -> Scenario:
    """The scenario of a noise, with what a variant takes from another one."""
    scenario = find_scenario(NOISES[noise])
    if (name := variant.removesuffix(" tuned")) in WRONG:
        other = find_scenario(WRONG[name])
        parts = {part: getattr(other, part) for part in ("parameter_factors", "amplifier", "flow")}
        return scenario.replace(**parts)
    return scenario


@cache
def _tuned(filter_name: str, noise: str, variant: str) -> Mapping:
    """Q and R that a study finds on the noise's scenario, where voltages are held at random levels."""
    quiet_optuna()
    scenario = _scenario(noise, variant)
    plan = Plan(filter_name, (scenario,))
    study = open_study("policies", plan, None)
    return run_study(study, plan, TUNING_TRIALS).or_interrupted().choice.model


def _plain(arguments: Mapping) -> dict:
    return {name: np.asarray(value).tolist() for name, value in arguments.items()}
