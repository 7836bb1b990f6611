"""Learning: every arm and algorithm; it goes on after an interruption, a kill or a full disk; saved policies."""
# ruff: noqa: F811 - fixtures come by import and go by name

import errno
import os
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")
pytest.importorskip("stable_baselines3")

from tests.filters.checks import refused
from tests.fuzz.checkpoints import kill_training
from tests.learners import COPIES, LIMIT, contents, copied, learn, setup_of, short_episodes, steps_of, trained  # noqa: F401 - some are fixtures
from tuning.policies import saved
from tuning.policies.algorithms import ALGORITHMS, OBSERVATION_SETS
from tuning.policies.environments import make_environments
from tuning.policies.learn import VALIDATION_EPISODES, _episodes_after, mend
from tuning.policies.saved import BEST, CHECKPOINTS, EVALUATIONS, FINAL, SETUP
from tuning.problems.data import held_out_seeds


@pytest.mark.parametrize("observe", OBSERVATION_SETS)
def test_a_policy_learns_on_every_arm_and_is_scored(observe, tmp_path):
    setup, told = setup_of(observe), []
    run = learn(setup, tmp_path / "policy", on_progress=lambda steps, value: told.append((steps, value)))
    assert run.steps == run.learnt == 256 and not run.interrupted and run.seconds > 0
    assert [steps for steps, _ in run.curve] == [128, 256] and all(value < 0 for _, value in run.curve)
    assert [steps for steps, _ in told] == list(range(COPIES, 257, COPIES))
    assert np.isnan(told[0][1]) and told[-1][1] == run.curve[-1][1]
    seeds = held_out_seeds(0, 3)
    policy = saved.load(saved.find_saved(run.folder), make_environments(setup, seeds))
    scores = saved.score(policy, setup, seeds)
    assert scores.returns.shape == (3,) and (scores.returns < 0).all()
    assert scores.parts["all"].steps.sum() == 3 * LIMIT


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_policy_learns_by_every_algorithm_goes_on_and_acts_the_same_when_loaded(algo, tmp_path):
    setup = setup_of(algo=algo, steps=128)
    told = setup.as_json()
    folder = learn(setup, tmp_path / "policy").folder
    assert setup.as_json() == told, "else another process finds another setup in the folder"
    longer = replace(setup, steps=256)
    run = learn(longer, folder)
    assert (run.steps, run.learnt) == (256, 128)
    assert [steps for steps, _ in run.curve] == [64, 128, 256]
    assert (
        steps_of(saved.find_saved(folder)) == 256
        and saved.read_configuration(saved.find_saved(folder)).steps == 256
    )
    seen = np.random.default_rng(0).normal(0, 20, (5, 4)).astype(np.float32)
    policies = [saved.load(saved.find_saved(folder), make_environments(setup, [0, 1])) for _ in range(2)]
    first, second = (policy.predict(seen)[0] for policy in policies)
    np.testing.assert_array_equal(first, second)
    assert first.shape == (5, 1) and (abs(first) <= 1).all()
    assert (saved.score(policies[0], setup, held_out_seeds(0, 2)).returns < 0).all()


def test_what_is_saved_acts_as_what_learnt(tmp_path, monkeypatch):
    import tuning.policies.learn as module

    kept = {}
    save = module.save

    def spy(folder, setup, model, replay=False):
        save(folder, setup, model, replay)
        normalise = model.get_vec_normalize_env()
        kept[folder.name] = model.predict(normalise.normalize_obs(seen), deterministic=True)[0]

    seen = np.random.default_rng(1).normal(0, 20, (6, 4)).astype(np.float32)
    monkeypatch.setattr(module, "save", spy)
    setup = setup_of()
    folder = learn(setup, tmp_path / "policy").folder
    for name, expected in kept.items():
        paths = folder / FINAL, folder / "best", folder / CHECKPOINTS / name
        found = next(path for path in paths if path.name == name)
        if found.exists():
            actions = saved.load(found, make_environments(setup, [0])).predict(seen)[0]
            np.testing.assert_allclose(actions, expected, rtol=1e-5, atol=1e-7)  # tanh is torch's again
    assert FINAL in kept and "best" in kept


def test_an_interrupted_training_goes_on_where_it_was(tmp_path):
    setup, folder, seen = setup_of(steps=512), tmp_path / "policy", []

    def interrupt(steps, value):
        if steps == 300:
            os.kill(os.getpid(), signal.SIGINT)

    first = learn(setup, folder, on_progress=interrupt)
    assert first.interrupted and first.steps == 300 and not (folder / FINAL).exists()
    assert saved.find_saved(folder).name == "000000300"
    second = learn(setup, folder, on_progress=lambda steps, value: seen.append(steps))
    assert seen[0] == 304 and not second.interrupted
    assert second.steps >= 512 and second.learnt == second.steps - 300
    assert second.curve[: len(first.curve)] == first.curve and len(second.curve) > len(first.curve)
    assert len(list((folder / CHECKPOINTS).iterdir())) == 2
    before = contents(folder)
    third = learn(setup, folder)
    assert third.learnt == 0 and third.curve == second.curve
    assert contents(folder) == before, "a finished training is left alone"


def test_a_longer_training_that_is_interrupted_is_not_lost(copied):
    longer = replace(setup_of(), steps=1024)

    def interrupt(steps, value):
        if steps == 400:
            os.kill(os.getpid(), signal.SIGINT)

    assert learn(longer, copied, on_progress=interrupt).steps == 400
    assert steps_of(saved.find_saved(copied)) == 400
    seen = []
    learn(longer, copied, on_progress=lambda steps, value: seen.append(steps))
    assert seen[0] == 404


def test_episodes_of_training_evaluation_and_proof_differ(tmp_path, monkeypatch):
    import tuning.policies.learn as module

    made, reset = [], []
    make = module.make_environments

    def spy(*arguments, **named):
        venv = make(*arguments, **named)
        base = venv.unwrapped
        monkeypatch.setattr(base, "reset", lambda of=base.reset: (reset.append(list(base._seeds)), of())[1])
        made.append(venv)
        return venv

    monkeypatch.setattr(module, "make_environments", spy)
    setup, folder = setup_of(seed=3), tmp_path / "policy"
    learn(setup, folder)
    learn(replace(setup, steps=512), folder)
    used = [set(seeds) for seeds in reset]
    learning = [seeds for seeds in used if len(seeds) == COPIES]
    validation = [seeds for seeds in used if len(seeds) == VALIDATION_EPISODES]
    assert len(learning) == 2 and not learning[0] & learning[1]
    assert len(validation) >= 3 and all(seeds == validation[0] for seeds in validation)
    assert not validation[0] & (learning[0] | learning[1])
    everything = set().union(*used)
    assert min(everything) >= 3_000_000 and max(everything) < held_out_seeds(3, 2)[0]


@pytest.mark.parametrize("steps", [0, 401_408, 10**9])
def test_a_training_goes_on_after_any_number_of_steps_with_episodes_of_its_own(steps):
    seeds = _episodes_after(setup_of("ekf"), steps)
    assert len(set(seeds)) == COPIES and min(seeds) >= VALIDATION_EPISODES
    assert max(seeds) < held_out_seeds(0, 2)[0]


def test_a_setup_survives_its_text():
    for observe in OBSERVATION_SETS:
        setup = setup_of(observe)
        again = saved.configuration_from_json(setup.as_json(), "setup.json")
        assert again == setup and not setup.differences(again)


@pytest.mark.parametrize("observe", ["stack", "ekf"])
def test_native_envs_and_single_ones_give_the_same_learning_curve(observe, tmp_path):
    setup = setup_of(observe, steps=512)
    curves = (learn(setup, tmp_path / str(own), native=own, evaluations=4).curve for own in (True, False))
    native, single = curves
    assert len(native) == 4 and native[0][1] != native[-1][1]
    assert np.array(single) == pytest.approx(np.array(native), rel=1e-3)


def test_the_learning_rate_never_falls_below_zero(tmp_path):
    setup = setup_of(steps=200)  # whole rollouts end at 256
    model = saved.load(learn(setup, tmp_path / "ekf").folder / FINAL, make_environments(setup, [0])).model
    assert model.num_timesteps == 256 and model.lr_schedule(1.0) == setup.hyperparameters["learning_rate"]
    assert model.policy.optimizer.param_groups[0]["lr"] == 0.0 == model.lr_schedule(-0.1)


def test_evaluations_that_find_no_room_do_not_spoil_those_before(tmp_path, monkeypatch):
    setup = setup_of("raw")
    savez, written = np.savez, []

    def full(path, **arrays):
        written.append(path)
        if len(written) == 2:
            with open(f"{path}.npz", "wb") as file:
                file.write(b"PK")
            raise OSError(errno.ENOSPC, "No space left on device")
        savez(path, **arrays)

    with monkeypatch.context() as patch:
        patch.setattr(np, "savez", full)
        with pytest.raises(OSError, match="No space left"):
            learn(setup, tmp_path / "p")
    with np.load(tmp_path / "p" / f"{EVALUATIONS}.npz") as kept:
        assert kept["timesteps"].tolist() == [128]
    trained = learn(setup, tmp_path / "p")
    assert [steps for steps, _ in trained.curve][0] == 128 and trained.steps >= 256


class Killed(BaseException):
    """Like SIGKILL, an end that nothing catches."""


def test_what_was_being_written_is_cleared_away_and_what_was_being_replaced_is_put_back(copied):
    before, saved = contents(copied), copied / BEST
    shutil.copytree(saved, copied / CHECKPOINTS / ".000000300.x1y2z3")
    shutil.copytree(saved, copied / ".final.gone")
    (copied / f".{SETUP}.abc").write_text("{")
    (copied / ".evaluations.npz").write_bytes(b"PK half")
    os.replace(saved, copied / ".best.old")
    mend(copied)
    assert contents(copied) == before
    shutil.copytree(saved, copied / ".best.old")
    (copied / ".best.old" / SETUP).write_text("of before")
    mend(copied)
    assert contents(copied) == before


def test_a_training_that_was_killed_before_its_setup_was_there_starts_anew(tmp_path):
    (tmp_path / f".{SETUP}.abc").write_text("{")
    assert learn(setup_of(steps=128), tmp_path).learnt == 128
    assert not list(tmp_path.rglob(".*"))


def test_a_folder_of_something_else_is_left_as_it_is(tmp_path):
    (tmp_path / ".best.old").write_text("mine")
    (tmp_path / "notes").write_text("mine")
    before = contents(tmp_path)
    refused("the folder must be new, empty or that of a training", learn, setup_of(steps=128), tmp_path)
    assert contents(tmp_path) == before


def test_an_end_while_evaluations_are_written_leaves_those_of_before(copied, monkeypatch):
    before = (copied / "evaluations.npz").read_bytes()

    def half(path, **arrays):
        with open(f"{path}.npz".replace(".npz.npz", ".npz"), "wb") as stream:
            stream.write(b"PK")
        raise Killed

    longer = setup_of(steps=512)
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(np, "savez", half)
        learn(longer, copied)
    assert (copied / "evaluations.npz").read_bytes() == before
    assert learn(longer, copied).steps == 512


def test_an_end_while_a_policy_is_removed_leaves_none_that_is_half_there(copied, monkeypatch):
    def half(path, **options):
        if path.exists():
            (path / "normalisation.pkl").unlink()
            raise Killed

    longer = setup_of(steps=512)
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(shutil, "rmtree", half)
        learn(longer, copied)  # whose final policy becomes a checkpoint that is there already
    assert not (copied / FINAL).exists() and steps_of(saved.find_saved(copied)) == 256
    assert learn(longer, copied).learnt == 256


@pytest.mark.slow
def test_a_training_that_is_killed_loses_no_more_than_the_steps_since_its_checkpoint(monkeypatch):
    monkeypatch.setattr("tests.fuzz.checkpoints.STEPS", 1024)
    monkeypatch.setattr("tests.fuzz.checkpoints.BETWEEN", 16)  # with 64 checkpoints
    assert kill_training(np.random.default_rng(0), 1, 600).startswith("1 kills")
