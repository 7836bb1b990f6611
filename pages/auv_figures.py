"""Make the picture of docs/auv.md and its computed table.

    python -m pages.auv_figures [FOLDER]

The picture goes into FOLDER, docs/ by default. Every run gives the same.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np

import thruster_env.auv  # noqa: F401 - registers the envs
from filters import EstimateState
from pages.page import digits, make_page
from thruster_env.auv.control import DepthAndCourse
from thruster_env.auv.paths import MANOEUVRES
from thruster_env.core.files import write_whole
from thruster_env.core.text_tables import markdown_table
from thruster_env.env.commands import ObserveStateVector


def frame(path: Path) -> Path:
    """A frame of path IV under PD on the estimate of an extended Kalman filter."""
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    from matplotlib.image import imsave

    env = EstimateState(gym.make("SegorogeniAUVPath-v0", path="IV", render_mode="rgb_array"), "ekf")
    controller, state = DepthAndCourse.for_env(env, "navigation"), None
    observation, _ = env.reset(seed=3)
    for _ in range(420):
        action, state = controller.predict(observation, state)
        observation, *_ = env.step(action)
    picture = env.render()
    env.close()
    write_whole(path, lambda stream: imsave(stream, picture, format="png"))
    return path


def returns() -> str:
    """Mean return of an episode: PD on measurements, on the true state, and planes held still."""
    tasks = [("Path", {"path": name}) for name in MANOEUVRES] + [("Depth", {})]
    rows = []
    for task, arguments in tasks:
        name = f"SegorogeniAUV{task}-v0"
        env = gym.make_vec(name, EPISODES, **arguments)
        true = ObserveStateVector(gym.make_vec(name, EPISODES, **arguments))
        scores = (
            mean_return(env, DepthAndCourse.for_env(env)),
            mean_return(true, DepthAndCourse.for_env(true, "navigation")),
            mean_return(env, None),
        )
        rows.append([f"path {arguments['path']}" if arguments else "depth", *(digits(score) for score in scores)])
    return markdown_table(["task", "PD on measurements", "PD on the true state", "planes still, 2.845 N"], rows)


def mean_return(env, controller: DepthAndCourse | None) -> float:
    """Mean return of the first episodes of all copies, which none may end before its time."""
    observations, _ = env.reset(seed=0)
    action, state, total = np.tile(np.float32([2.845, 0.0, 0.0]), (env.num_envs, 1)), None, 0.0
    for _ in range(gym.spec(env.spec.id).max_episode_steps):
        if controller is not None:
            action, state = controller.predict(observations, state)
        observations, rewards, terminated, *_ = env.step(action)
        if terminated.any():
            raise RuntimeError(f"no episode of {env.spec.id} may end early, but one did")
        total += rewards.mean()
    return total


FIGURES = {"auv_frame.png": frame}
TABLES = {"returns": returns}
EPISODES = 50


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    make_page("auv", "pages.auv_figures", FIGURES, TABLES, __doc__.splitlines()[0], arguments)


if __name__ == "__main__":
    main()
