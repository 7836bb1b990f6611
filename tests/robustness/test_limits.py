"""What floating point or memory could not hold is refused in one line, where it becomes a count or a scale."""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the envs
from filters import make_filter, thruster_model
from filters.tuned_file import read_tuned_file
from tests.robustness.test_wrong_arguments import refused
from thruster_env.core.checks import as_floats, short_repr, vector
from thruster_env.thruster.parameters import TUNNEL
from tuning.cli.simulate import command
from tuning.experiments.thruster_papers import compare
from tuning.plants.thruster import SCENARIOS
from tuning.policies.saved import configuration_from_json
from tuning.problems.data import held_out_seeds, training_seeds
from tuning.problems.find import read_scenario

pytestmark = pytest.mark.usefixtures("as_python")
HUGE = 10**12


@pytest.mark.parametrize(
    ("name", "arguments", "rule"),
    [
        ("", {"dt": 1e-300}, "dt must be from 1e-09 to 10 s, but got 1e-300"),
        ("", {"dt": 1e9}, "dt must be from 1e-09 to 10 s, but got 1000000000.0"),
        ("", {"max_voltage": 1e-300}, "max_voltage must be from 0.001 to 1e[+]06 V, but got 1e-300"),
        ("", {"ambient_velocity": 1e100}, "ambient_velocity must be within plus and minus 1000, but got"),
        ("", {"initial_state": [1e300, 0.0]}, "initial_state must be within plus and minus 1e[+]50, but got"),
        ("", {"initial_state": {"mean": [0, 0], "cov": [1e300, 1]}}, "the cov of initial_state must be at most"),
        ("", {"process_noise_cov": [1e300, 1.0]}, r"process_noise_cov must be at most 1e\+100 in every entry"),
        ("", {"measurement_noise_cov": 1e300}, r"measurement_noise_cov must be at most 1e\+100 in every entry"),
        ("", {"tracking_weight": 1e300}, "tracking_weight must be within plus and minus 1e[+]09, but got"),
        (
            "",
            {"preset": TUNNEL._replace(diameter=1e300)},
            r"diameter must be from 1e-12 to 1e\+12, but got 1e\+300",
        ),
        ("", {"uncertainty": {"load_gain": {"name": "log-normal", "std": 300}}}, "std must be at most 2"),
        ("", {"sensors": {"thrust": [{"name": "delay", "steps": 1e15}]}}, "steps must be at most 10000"),
        ("Linear", {"dt": 1e-320}, "dt must be from 1e-09 to 10 s"),
        ("Linear", {"max_voltage": 1e100}, "max_voltage must be from 0.001 to"),
        ("Tracking", {"reference": {"name": "steps", "hold_time": 1e300}}, r"hold_time must be at most 1e\+09 s"),
        (
            "Tracking",
            {"reference": {"name": "steps", "high": 1e300}},
            "arguments of 'steps' must be zero, or from",
        ),
        (
            "Tracking",
            {"reference": {"name": "multi-sine", "periods": [1, 1e-300]}},
            "arguments of 'multi-sine' must",
        ),
        (
            "",
            {"sensors": {"thrust": [{"name": "quantisation", "step": 1e-300}]}},
            "arguments of 'quantisation' must",
        ),
        (
            "",
            {"flow": [{"name": "recorded", "values": [0.0, 1e-300]}]},
            "arguments of 'recorded' must be zero, or",
        ),
    ],
)
def test_an_env_of_numbers_beyond_floating_point_is_refused(name, arguments, rule):
    refused(lambda: gym.make(f"BowThruster{name}-v0", **arguments), rule)


@pytest.mark.parametrize("vector_env", [False, True])
def test_an_episode_does_not_start_beyond_floating_point(vector_env):
    env = gym.make_vec("BowThruster-v0", 2) if vector_env else gym.make("BowThruster-v0").unwrapped
    rule = r"the state of options must be within plus and minus 1e\+50, but got \[1e\+300, 0\]"
    refused(lambda: env.reset(options={"state": [1e300, 0]}), rule)
    info = env.reset(seed=0, options={"state": [1e50, -1e50]})[1]
    assert all(np.isfinite(value).all() for value in info.values())


def test_counts_have_limits():
    gym_make = {"num_envs": 10**9}
    refused(
        lambda: gym.make_vec("BowThruster-v0", **gym_make), "num_envs must be at most 1000000, but got 1000000000"
    )
    refused(lambda: held_out_seeds(0, HUGE), "seeds must be at most 20000, but got 1000000000000")
    refused(lambda: training_seeds(0, HUGE), "seeds must be at most 500000, but got 1000000000000")
    refused(lambda: SCENARIOS["nominal"].replace(steps=HUGE), "steps must be at most 1000000, but got")
    refused(lambda: compare("tunnel", 0.5, runs=HUGE), "runs must be at most 100000, but got")
    refused(lambda: command(out=Path("x.csv"), steps=HUGE), "steps must be at most 10000000")
    model = thruster_model()
    of_filters = {"gsf": "parts", "vb": "iterations", "ienkf": "iterations", "kf": "schedule", "mhe": "horizon"}
    for name, number in of_filters.items():
        refused(lambda: make_filter(name, model, **{number: HUGE}), f"{number} must be at most")  # noqa: B023


def endless():
    """A list and a dictionary that hold themselves."""
    values, mapping = [1.0], {}
    values.append(values)
    mapping["more"] = mapping
    return values, mapping


def deep(depth=100_000):
    """A list in a list in a list ..."""
    values = []
    for _ in range(depth):
        values = [values]
    return values


def test_what_holds_itself_is_refused():
    for value in (*endless(), deep()):
        assert "\n" not in short_repr(value)
        refused(lambda: as_floats(value), "an array must be")  # noqa: B023
        refused(lambda: vector("state", value), "state must be")  # noqa: B023
        refused(lambda: gym.make("BowThruster-v0", sensors=[value]), "must")  # noqa: B023
        refused(lambda: gym.make("BowThruster-v0", initial_state=value), "initial_state must be")  # noqa: B023
        change = {"parameter_factors": {"area": value}}
        refused(lambda: SCENARIOS["nominal"].replace(**change), "must be nested at most 10 deep, but got")  # noqa: B023


def test_files_that_are_nested_without_end_are_refused(tmp_path):
    brackets = 200_000
    text = "[" * brackets + "]" * brackets
    with pytest.raises(RecursionError):
        json.loads(text)
    (tmp_path / "deep.json").write_text(text)
    refused(lambda: read_tuned_file(tmp_path / "deep.json"), "a tuned file must be whole JSON")
    refused(
        lambda: configuration_from_json(text, "policy.json"), "policy.json must hold the configuration of a policy"
    )
    (tmp_path / "deep.toml").write_text(f"steps = {text}")
    refused(lambda: read_scenario(tmp_path / "deep.toml"), "a scenario file must be TOML")
