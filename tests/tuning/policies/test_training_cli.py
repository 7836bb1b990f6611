"""`thruster train`, `score` and `play`, and the films that they make."""
# ruff: noqa: F811 - fixtures come by import and go by name

import importlib.util
import json
import sys

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from tests.learners import COPIES, LIMIT, SMALL, contents, setup_of, short_episodes, trained  # noqa: F401 - some are fixtures
from tuning.plants.thruster import find_scenario
from tuning.policies.algorithms import ALGORITHMS
from tuning.policies.environments import make_environments
from tuning.policies.saved import FINAL, load, play, read_configuration, score
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
    scored = thruster(
        "score", folder, raw, "--seeds", 5, "--classical", "pi", "--classical", "mpc", "--json", "score.json"
    )
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
    tuned, untuned = (
        read_configuration(tmp_path / name / FINAL).filter_arguments for name in ("tuned", "untuned")
    )
    assert tuned["process_noise_cov"] == numbers["process_noise_cov"]
    assert untuned["measurement_noise_cov"] == find_scenario("medium_noise").measurement_noise_cov
    line = "filter of the tuned file must be one of ukf, but got 'ekf'"
    assert line in thruster(*options, "other", "--observe", "ukf", "--tuned", "mine.json").stderr
    assert not (tmp_path / "other").exists()
