"""Episodes without a learnt policy, drawn: under a PI controller, a sequence of voltages, or as a log has them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import thruster_env  # noqa: F401 - registers the envs
from filters import EstimateState
from filters.logs.estimate import LogEstimate
from filters.logs.estimate import estimate as estimate_log
from thruster_env.core.checks import at_least, one_of, within
from thruster_env.core.streams import episode_keys
from thruster_env.logs.log import Log
from thruster_env.render.renderer import OnStep, Played, steps_a_frame, write_video
from thruster_env.thruster.control.controllers import PIController
from thruster_env.thruster.env import renderer_of
from thruster_env.thruster.rendering.renderer import Moment, Overlay
from tuning.cli.output import warn_beyond
from tuning.problems.excitation import EXCITATIONS, excitation_of
from tuning.thruster.excitation import voltages_of

POLICIES = ("pi",)
SEQUENCES = tuple(name for name in EXCITATIONS.effects if name not in POLICIES)
ENV = "BowThrusterTracking-v0"
MOST_STEPS = 100_000


def play_pi(video: Path | None, seed: int, on_step: OnStep, **arguments) -> Played:
    """One episode of the env that follows a reference, by the PI controller on its measured thrust.

    Args:
        video: an .mp4 or .gif file; None for a window.
        seed: of the episode.
        on_step: called after each step.
        **arguments: of `estimated_env`.
    """
    with estimated_env(video, **arguments) as env:
        controller, state, ended = PIController.for_env(env), None, True

        def act(observation, step: int) -> np.ndarray:
            nonlocal state, ended
            action, state = controller.predict(observation, state, np.array(ended))
            ended = False
            return action

        return _played(env, act, video, seed, on_step)


def play_voltages(
    video: Path | None, seed: int, on_step: OnStep, given: float | str, steps: int, **arguments
) -> Played:
    """A thruster under a constant voltage [V], or a sequence by the name of an excitation."""
    if not isinstance(given, str):
        warn_beyond(arguments.get("preset", "tunnel"), given)
    with estimated_env(video, steps=steps, **arguments) as env:
        thruster: Any = env.unwrapped
        plant = thruster.plant
        if isinstance(given, str):
            excitation = excitation_of({"name": one_of("excitation", given, SEQUENCES)})
            voltages = voltages_of(excitation, plant, episode_keys([seed]), steps)[0]
        else:
            voltages = np.full(steps, within("voltage", given, plant.max_voltage))
        moment = thruster.moment_of  # there is a reference, but nobody follows it
        thruster.moment_of = lambda report: moment(report)._replace(reference=None)
        return _played(env, lambda observation, step: voltages[[step]], video, seed, on_step)


@contextmanager
def estimated_env(
    video: Path | None,
    preset: str = "tunnel",
    steps: int = 500,
    filter: str | None = None,
    tuned: Path | None = None,
    size: tuple[int, int] | None = None,
) -> Iterator[gym.Env]:
    """A thruster drawn with a filter's estimate.

    Args:
        video: None for a window.
        preset: of the thruster.
        steps: of an episode.
        filter: by name; "ekf" if None and no tuned file.
        tuned: path of a tuned file.
        size: of pictures, (width, height) [px]; None for the env's own.
    """
    at_least("steps", steps, 1, MOST_STEPS)
    mode = "human" if video is None else "rgb_array"
    env = gym.make(ENV, preset=preset, render_mode=mode, render_size=size, max_episode_steps=steps)
    try:
        given = {"filter": filter} if tuned is None else {"tuned": str(tuned)}
        yield EstimateState(env, observation="measurement+estimate", **given)
    finally:
        env.close()


def _played(env, act, video: Path | None, seed: int, on_step: OnStep) -> Played:
    every, dt = steps_a_frame(video, env.unwrapped.plant.dt), env.unwrapped.plant.dt
    count = env.spec.max_episode_steps
    observation, _ = env.reset(seed=seed)
    frames = [env.render()] if every else []
    steps, total, over = 0, 0.0, False
    while not over:
        observation, reward, terminated, truncated, _ = env.step(act(observation, steps))
        steps, total, over = steps + 1, total + float(reward), terminated or truncated
        if every and steps % every == 0:
            frames.append(env.render())
        on_step(steps, count)
    if video is not None:
        write_video(video, frames, 1 / (dt * every))
    return Played(steps, total, steps * dt)


def play_log(
    video: Path | None,
    log: Log,
    offer,
    on_step: OnStep,
    *,
    filter: str | None = None,
    tuned: Path | None = None,
    size: tuple[int, int] | None = None,
    seed: int = 0,
) -> Played:
    """A recorded run of a thruster: its voltage and measurements, what else was recorded, and a filter's estimate.

    Args:
        video: an .mp4 or .gif file; None for a window.
        log: of the thruster.
        offer: what offers its model and has its `plant`.
        on_step: called after each row.
        filter: by name; "ekf" if None and no tuned file.
        tuned: path of a tuned file.
        size: of pictures, (width, height) [px]; None for the env's own.
        seed: of the filter's random numbers.
    """
    found = estimate_log(log, filter, offer, tuned=tuned, seed=seed)
    every = steps_a_frame(video, log.dt)
    largest = float(np.abs(log.inputs).max())
    plant = offer.plant._replace(max_voltage=max(offer.plant.max_voltage, largest), dt=log.dt)
    mode = "human" if video is None else "rgb_array"
    renderer = renderer_of(plant, mode, max(1, round(1 / log.dt)), size)
    frames: list[np.ndarray] = []
    try:
        for row, (moment, overlay) in enumerate(zip(moments(log), overlays(found), strict=True)):
            renderer.add(moment, overlay)
            if video is None or row % every == 0:
                frame = renderer.draw()
                if frame is not None:  # in no window
                    frames.append(frame)
            on_step(row, log.steps)
        if video is not None:
            write_video(video, frames, 1 / (log.dt * every))
    finally:
        renderer.close()
    return Played(log.steps, 0.0, log.steps * log.dt)


def moments(log: Log) -> Iterator[Moment]:
    """The recorded values, row by row; NaN where there are none."""
    columns: Mapping[str, np.ndarray] = {
        **{one.symbol: log.measurements[:, i] for i, one in enumerate(log.measured)},
        **{channel.rpartition(":")[2]: values for channel, values in log.references.items()},
    }
    nowhere = np.full(log.steps + 1, np.nan)
    omega, flow, thrust = (columns.get(name, nowhere) for name in ("omega_m", "U_a", "T"))
    measured = columns.get("thrust", nowhere)
    voltages = np.append(log.inputs[:, 0], log.inputs[-1, 0])
    for k in range(log.steps + 1):
        yield Moment(k * log.dt, omega[k], flow[k], thrust[k], measured[k], None, voltages[k])


def overlays(found: LogEstimate) -> Iterator[Overlay]:
    """The filter's estimates, row by row."""
    thrusts, stds = found.output("T")
    for mean, std, thrust, thrust_std in zip(found.means, found.stds, thrusts, stds, strict=True):
        pairs = [number for pair in zip(mean[:2], std[:2], strict=True) for number in pair]
        yield Overlay(found.filter.name, thrust, thrust_std, *pairs)
