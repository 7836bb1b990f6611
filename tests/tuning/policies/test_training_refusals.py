"""What training, scoring and playing refuse: one clear line, and nothing is overwritten."""
# ruff: noqa: F811 - fixtures come by import and go by name

import importlib.util
import shutil
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from tests.learners import SMALL, contents, copied, learn, setup_of, short_episodes, trained  # noqa: F401 - some are fixtures
from tuning.plants.thruster import find_scenario
from tuning.policies.algorithms import check_installed
from tuning.policies.environments import make_environments
from tuning.policies.saved import FINAL, configuration_from_json, find_saved, load, play
from tuning.policies.setup import make_configuration


def damage(path, how):
    if how == "cut":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif how == "noise":
        path.write_bytes(np.random.default_rng(0).bytes(200))
    else:
        path.unlink()


@pytest.mark.parametrize("how", ["cut", "noise", "missing"])
@pytest.mark.parametrize("name", ["policy.zip", "normalisation.pkl", "setup.json"])
def test_a_damaged_file_is_one_clear_line_and_nothing_is_overwritten(name, how, copied):
    damage(copied / FINAL / name, how)
    before = contents(copied)
    with pytest.raises(
        ValueError, match=r"but .*(cannot be read|is missing|is not readable|got|holds none)"
    ) as error:
        folder = find_saved(copied / FINAL)
        load(folder, make_environments(setup_of(), [0]))
    assert "\n" not in str(error.value) and len(str(error.value)) < 600
    if (name, how) != ("policy.zip", "missing"):  # then the latest checkpoint is what there is
        with pytest.raises(ValueError):
            learn(replace(setup_of(), steps=2048), copied)
        assert contents(copied) == before


def test_a_damaged_checkpoint_is_refused(copied):
    shutil.rmtree(copied / FINAL)
    damage(find_saved(copied) / "policy.zip", "cut")
    before = contents(copied)
    with pytest.raises(ValueError, match=r"policy.zip must be a whole file as it was saved, but cannot be read"):
        learn(setup_of(), copied)
    assert contents(copied) == before


@pytest.mark.parametrize("how", ["cut", "noise"])
def test_damaged_evaluations_are_refused_and_left_alone(how, copied):
    damage(copied / "evaluations.npz", how)
    before = contents(copied)
    with pytest.raises(
        ValueError, match=r"evaluations.npz must be a whole file as it was saved, but cannot be read"
    ):
        learn(replace(setup_of(), steps=2048), copied)
    assert contents(copied) == before


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"observe": "ukf"}, "observe"),
        ({"observe": "raw"}, "observe"),
        ({"algo": "sac", "hyperparameters": SMALL["sac"]}, "algo, hyperparameters"),
        ({"seed": 1}, "seed"),
        ({"filter_arguments": {"process_noise_cov": [1.0, 1.0]}}, "filter_arguments"),
    ],
)
def test_a_folder_of_another_setup_is_left_alone(change, named, copied):
    before = contents(copied)
    with pytest.raises(ValueError, match=f"to continue, but differs in {named}: give another folder"):
        learn(setup_of(**change), copied)
    assert contents(copied) == before


def test_a_folder_of_other_things_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("precious")
    for folder in (tmp_path, tmp_path / "thesis.txt"):
        with pytest.raises(
            ValueError, match="must be new, empty or that of a training, but .* contains other files"
        ):
            learn(setup_of(), folder)
    assert contents(tmp_path) == {(tmp_path / "thesis.txt").relative_to(tmp_path): b"precious"}


def test_a_policy_needs_the_observation_it_was_trained_on(trained):
    with pytest.raises(ValueError, match="on observe='ekf' must see 4 numbers, but the env shows 2"):
        load(trained / FINAL, make_environments(setup_of("raw"), [0]))


def test_unknown_names_and_wrong_numbers_are_refused():
    for arguments, line in [
        ({"observe": "none"}, "observe must be one of raw, "),
        ({"algo": "a2c", "hyperparameters": {}}, "algo must be one of ppo, "),
        ({"steps": 0}, "steps must be"),
        (
            {"observe": "raw", "filter_arguments": {"process_noise_cov": 1}},
            "with an observation set that has a filter, but got",
        ),
    ]:
        with pytest.raises(ValueError, match=line):
            make_configuration("tracking", find_scenario("nominal"), **{"observe": "ekf", **arguments})
    with pytest.raises(ValueError, match="task must be one of"):
        make_configuration("parking", find_scenario("nominal"), "ekf")
    with pytest.raises(ValueError, match="but 'published_tunnel' is linear"):
        make_configuration("tracking", find_scenario("published_tunnel"), "ekf")


@pytest.mark.parametrize("text", ["", "[1]", '{"version": 1}', '{"version": 99}', '{"version": "x"}', "{}"])
def test_the_setup_of_a_policy_must_be_one(text):
    with pytest.raises(ValueError, match="setup.json must (hold the configuration of a policy|be of version 1)"):
        configuration_from_json(text, "setup.json")


def without(package, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == package else find(name, *rest)
    )


@pytest.mark.parametrize("package", ["torch", "stable_baselines3", "sb3_contrib"])
def test_a_missing_extra_is_named(package, monkeypatch, thruster, tmp_path):
    without(package, monkeypatch)
    line = f"policies need {package}, which is not installed: pip install '.[rl]' in the project's folder"
    with pytest.raises(ValueError) as error:
        check_installed()
    assert str(error.value) == line
    for arguments in (("train",), ("play", "x"), ("score", "x")):
        done = thruster(*arguments)
        assert (done.returncode, done.stderr) == (2, f"thruster: {line}\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("package", ["pygame", "moviepy"])
def test_drawing_names_its_extra(package, monkeypatch, copied):
    without(package, monkeypatch)
    before = contents(copied)
    with pytest.raises(ValueError, match=f"drawing needs {package}, .* pip install '.\\[render\\]'"):
        play(copied / FINAL, copied / "film.mp4", 1)
    assert contents(copied) == before


BAD = [
    (("train", "--observe", "none"), "observe must be one of raw, raw+action"),
    (("train", "--algo", "none"), "algo must be one of ppo"),
    (("train", "--controller", "pi"), "controller must be one of one-step, mpc, but got 'pi'"),
    (("train", "--observe", "raw", "--controller", "mpc"), "mpc must observe a state, but got observe='raw'"),
    (("train", "--task", "none"), "task must be one of tracking"),
    (("train", "--scenario", "none"), "scenario must be one of nominal"),
    (("train", "--steps", "0"), "steps must be"),
    (("train", "--untuned", "--tuned", "x.json"), "give either --tuned FILE or --untuned, but got both"),
    (("train", "--tuned", "no.json"), "a tuned file must be readable, but no.json is not"),
    (
        ("train", "--observe", "raw", "--untuned"),
        "must come with an observation set that has a filter, but got 'raw'",
    ),
    (("train", "--out", "full"), "must be new, empty or that of a training, but full contains other files"),
    (("play", "full"), "a policy must be a folder that `thruster train` made, but full holds none"),
    (("play", "ekf", "--out", "x.avi"), "--out must end in .mp4 or .gif, but got 'x.avi'"),
    (("play", "ekf", "--out", "x.gif", "--window"), "give either --window or --out FILE, but got both"),
    (("score", "ekf", "full"), "a policy must be a folder that `thruster train` made, but full holds none"),
    (("score", "ekf", "--classical", "pid"), "classical must be one of pi, lqr, one-step, mpc, but got 'pid'"),
    (
        ("score", "ekf", "--scenario", "dropout"),
        "trained on observe='ekf' must see 4 numbers, but the env shows 5",
    ),
    (("score", "ekf", "--scenario", "published_tunnel"), "'published_tunnel' is linear"),
]


@pytest.mark.parametrize(("arguments", "line"), BAD, ids=[" ".join(arguments) for arguments, _ in BAD])
def test_a_users_mistake_is_one_clear_line(arguments, line, thruster, copied, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("precious")
    before = contents(tmp_path)
    done = thruster(*arguments)
    assert done.returncode == 2 and line in done.stderr and "Traceback" not in done.stderr
    assert contents(tmp_path) == before
