"""`thruster train`, `score` and `play`, the films that they make, and what they refuse in one line."""
# ruff: noqa: F811 - fixtures come by import and go by name

import importlib.util
import json
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from tests.filters.checks import refused
from tests.learners import COPIES, LIMIT, SMALL, contents, copied, learn, setup_of, short_episodes, trained  # noqa: F401 - some are fixtures
from tuning.plants.thruster import find_scenario
from tuning.policies.algorithms import ALGORITHMS, check_installed
from tuning.policies.environments import make_environments
from tuning.policies.saved import FINAL, configuration_from_json, find_saved, load, play, read_configuration, score
from tuning.policies.setup import make_configuration
from tuning.problems.data import held_out_seeds


@pytest.mark.parametrize(("suffix", "size"), [("mp4", None), ("gif", (96, 64))])
def test_a_film_is_of_the_episode_that_is_scored(suffix, size, trained, tmp_path):
    pytest.importorskip("pygame")
    moviepy = pytest.importorskip("moviepy")
    setup, seeds = setup_of(), held_out_seeds(0, 2)
    played = play(trained / FINAL, tmp_path / f"film.{suffix}", seeds[0], size=size)
    policy = load(trained / FINAL, make_environments(setup, seeds))
    assert played.total_reward == pytest.approx(score(policy, setup, seeds).returns[0], rel=1e-4)
    assert played.steps == LIMIT and played.seconds == pytest.approx(LIMIT / 100)
    assert [path.name for path in tmp_path.iterdir()] == [f"film.{suffix}"]
    with moviepy.VideoFileClip(str(tmp_path / f"film.{suffix}")) as clip:
        assert tuple(clip.size) == (size or (640, 400))
        frames = [frame.astype(int) for frame in clip.iter_frames()]
    assert len(frames) >= 7 and np.abs(frames[-1] - frames[0]).mean() > 0.5


def test_the_commands_train_score_and_play(thruster, monkeypatch, tmp_path):
    monkeypatch.setattr(sys.modules["tuning.policies.setup"], "find_algorithm", small_algorithm)
    options = ("train", "--observe", "ekf", "--steps", 128, "--envs", COPIES, "--evaluations", 2)
    folder = tmp_path / "out" / "policies" / "tracking-medium_noise-ekf-ppo-seed0"
    done = thruster(*options, "--json", "train.json")
    assert done.returncode == 0, done.stderr
    for word in ("mean return", "128 steps", "steps/s", f"thruster play {folder.relative_to(tmp_path)}"):
        assert word in " ".join(done.stdout.split())
    data = json.loads((tmp_path / "train.json").read_text())
    assert data["steps"] == 128 and len(data["evaluations"]) == 2 and data["setup"]["observe"] == "ekf"
    idle, text = data["mean_return_of_zero_actions"], " ".join(done.stdout.split())
    assert idle < 0.0 and f"actions of zero have {idle:.3f} on the same episodes" in text
    assert ("no better than actions of zero" in text) == (data["evaluations"][-1]["mean_return"] <= idle)
    assert (folder / "tensorboard").is_dir()
    assert "training was already complete" in thruster(*options).stdout
    other = thruster("train", "--observe", "raw", "--steps", 128, "--envs", COPIES, "--no-tensorboard")
    assert other.returncode == 0, other.stderr
    before = contents(tmp_path / "out")
    raw = folder.with_name("tracking-medium_noise-raw-ppo-seed0")
    options = "--seeds", 5, "--classical", "pi", "--classical", "mpc", "--json", "score.json"
    scored = thruster("score", folder, raw, *options)
    assert scored.returncode == 0, scored.stderr
    rows = json.loads((tmp_path / "score.json").read_text())["policies"]
    assert [row["policy"] for row in rows] == ["ekf ppo", "raw ppo", "ekf pi", "raw pi", "ekf mpc"]
    assert rows[0]["over_the_first"]["value"] == 0.0 and len(rows[1]["returns"]) == 5
    assert rows[2]["mean_return"]["value"] > rows[0]["mean_return"]["value"]
    elsewhere = thruster("score", folder, "--seeds", 5, "--scenario", "ambient")
    assert elsewhere.returncode == 0 and "ekf ppo" in elsewhere.stdout
    assert contents(tmp_path / "out") == before
    if importlib.util.find_spec("pygame") and importlib.util.find_spec("moviepy"):
        played = thruster("play", folder, "--out", "film.gif")
        assert played.returncode == 0 and "Video: film.gif" in played.stdout


def small_algorithm(name):
    return ALGORITHMS[name]._replace(hyperparameters={**ALGORITHMS[name].hyperparameters, **SMALL[name]})


@pytest.mark.slow
def test_a_filter_is_trained_beside_as_it_is_told(thruster, monkeypatch, tmp_path):
    monkeypatch.setattr(sys.modules["tuning.policies.setup"], "find_algorithm", small_algorithm)
    study = ("tune", "--filter", "ekf", "--scenario", "nominal", "--trials", 4, "--out", "mine.json")
    assert thruster(*study).returncode == 0
    numbers = json.loads((tmp_path / "mine.json").read_text())["filter"]["model"]
    options = ("train", "--steps", 128, "--envs", COPIES, "--no-tensorboard", "--out")
    assert thruster(*options, "tuned", "--tuned", "mine.json").returncode == 0
    assert thruster(*options, "untuned", "--untuned").returncode == 0
    configurations = (read_configuration(tmp_path / name / FINAL) for name in ("tuned", "untuned"))
    tuned, untuned = (one.filter_arguments for one in configurations)
    assert tuned["process_noise_cov"] == numbers["process_noise_cov"]
    assert untuned["measurement_noise_cov"] == find_scenario("medium_noise").measurement_noise_cov
    line = "filter of the tuned file must be one of ukf, but got 'ekf'"
    assert line in thruster(*options, "other", "--observe", "ukf", "--tuned", "mine.json").stderr
    assert not (tmp_path / "other").exists()


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
        ValueError, match=r"but .*(cannot be read|is missing|not readable|got|holds none)"
    ) as error:
        folder = find_saved(copied / FINAL)
        load(folder, make_environments(setup_of(), [0]))
    assert "\n" not in str(error.value) and len(str(error.value)) < 600
    if (name, how) != ("policy.zip", "missing"):  # then the latest checkpoint is what there is
        with pytest.raises(ValueError):
            learn(replace(setup_of(), steps=2048), copied)
        assert contents(copied) == before


def test_a_damaged_checkpoint_and_a_folder_of_other_things_are_refused_and_left_alone(copied, tmp_path):
    shutil.rmtree(copied / FINAL)
    damage(find_saved(copied) / "policy.zip", "cut")
    before = contents(copied)
    refused(r"policy.zip must be a whole file as it was saved, but cannot be read", learn, setup_of(), copied)
    assert contents(copied) == before
    thesis = tmp_path / "full" / "thesis.txt"
    thesis.parent.mkdir()
    thesis.write_text("precious")
    for folder in (thesis.parent, thesis):
        refused("must be new, empty or that of a training, but .* contains other files", learn, setup_of(), folder)
    assert contents(tmp_path / "full") == {thesis.relative_to(thesis.parent): b"precious"}


@pytest.mark.parametrize("how", ["cut", "noise"])
def test_damaged_evaluations_are_refused_and_left_alone(how, copied):
    damage(copied / "evaluations.npz", how)
    before = contents(copied)
    with pytest.raises(ValueError, match=r"evaluations.npz must be a whole file as it was saved, but cannot be"):
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
    refused(f"to continue, but differs in {named}: give another folder", learn, setup_of(**change), copied)
    assert contents(copied) == before


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
            "an observation set that has a filter, but",
        ),
    ]:
        refused(line, make_configuration, "tracking", find_scenario("nominal"), **{"observe": "ekf", **arguments})
    refused("task must be one of", make_configuration, "parking", find_scenario("nominal"), "ekf")
    with pytest.raises(ValueError, match="but 'published_tunnel' is linear"):
        make_configuration("tracking", find_scenario("published_tunnel"), "ekf")


@pytest.mark.parametrize("text", ["", "[1]", '{"version": 1}', '{"version": 99}', '{"version": "x"}', "{}"])
def test_the_setup_of_a_policy_must_be_one(text):
    with pytest.raises(ValueError, match="setup.json must (hold the configuration of a policy|be of version 1)"):
        configuration_from_json(text, "setup.json")


def without(package, monkeypatch):
    find = importlib.util.find_spec

    def found(name, *rest):
        return None if name == package else find(name, *rest)

    monkeypatch.setattr(importlib.util, "find_spec", found)


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
    ("train --observe none", "observe must be one of raw, raw+action"),
    ("train --algo none", "algo must be one of ppo"),
    ("train --controller pi", "controller must be one of one-step, mpc, but got 'pi'"),
    ("train --observe raw --controller mpc", "mpc must observe a state, but got observe='raw'"),
    ("train --task none", "task must be one of tracking"),
    ("train --scenario none", "scenario must be one of nominal"),
    ("train --steps 0", "steps must be"),
    ("train --untuned --tuned x.json", "give either --tuned FILE or --untuned, but got both"),
    ("train --tuned no.json", "a tuned file must be readable, but no.json is not"),
    ("train --observe raw --untuned", "must come with an observation set that has a filter, but got 'raw'"),
    ("train --out full", "must be new, empty or that of a training, but full contains other files"),
    ("play full", "a policy must be a folder that `thruster train` made, but full holds none"),
    ("play ekf --out x.avi", "--out must end in .mp4 or .gif, but got 'x.avi'"),
    ("play ekf --out x.gif --window", "give either --window or --out FILE, but got both"),
    ("score ekf full", "a policy must be a folder that `thruster train` made, but full holds none"),
    ("score ekf --classical pid", "classical must be one of pi, lqr, one-step, mpc, but got 'pid'"),
    ("score ekf --scenario dropout", "trained on observe='ekf' must see 4 numbers, but the env shows 5"),
    ("score ekf --scenario published_tunnel", "'published_tunnel' is linear"),
]


@pytest.mark.parametrize(("arguments", "line"), BAD, ids=[arguments for arguments, _ in BAD])
def test_a_users_mistake_is_one_clear_line(arguments, line, thruster, copied, tmp_path):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("precious")
    before = contents(tmp_path)
    done = thruster(*arguments.split())
    assert done.returncode == 2 and line in done.stderr and "Traceback" not in done.stderr
    assert contents(tmp_path) == before
