"""The mechanics of a plant's env and vector env: seeds, steps, observations, infos, rendering, copies, spec."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy import ndarray

from thruster_env.core.checks import at_least, short_repr
from thruster_env.core.checks import seed as checked_seed
from thruster_env.core.sources import written_out
from thruster_env.core.streams import EpisodeKeys, draw_key, reset_mask
from thruster_env.env.copies import REWARD, TERMINATED, TIME, Page, PlantCopies
from thruster_env.env.plant_data import as_json, of_copies, some_numbers
from thruster_env.model.quantities import Quantity

if TYPE_CHECKING:
    from thruster_env.render.renderer import PlantRenderer


SMALLEST, LARGEST = 64, 4096  # side of a picture [px]


def checked_size(size: Sequence[int] | None) -> tuple[int, int] | None:
    """A size of pictures, (width, height) [px], as a pair of integers, or None; ValueError for any other."""
    if size is None:
        return None
    if not isinstance(size, (tuple, list)) or len(size) != 2:
        raise ValueError(f"render_size must be None or (width, height) in pixels, but got {short_repr(size)}")
    width, height = (
        at_least(f"the {side} of render_size", value, SMALLEST, LARGEST)
        for side, value in zip(("width", "height"), size, strict=True)
    )
    return width, height


FLOAT32_ENDS = 3e38  # casting beyond 3.4e38 would warn on its way to infinity


class ReportRows(NamedTuple):
    """Rows of a report, an array (reported,) or (reported, N), see `thruster_env.env.copies`."""

    measurement: slice  # of the m channels
    valid: slice  # whether each is valid
    dropping: tuple[int, ...]  # channels whose measurements may be missing; their validity stands in observations
    appended: tuple[int, ...]  # rows that stand last in the observation, such as a reference
    info: Mapping[str, int | slice]  # what info has, in order: a row for a number, several for a vector

    @classmethod
    def of(
        cls,
        rows: Mapping[str, Any],
        info: Sequence[str],
        appended: Sequence[str] = (),
        dropping: Sequence[int] = (),
    ) -> ReportRows:
        """Of the rows of a report by name: those that info has and that the observation appends."""
        rows = {"time": TIME, **rows}
        last = np.concatenate([[], *(np.r_[rows[name]] for name in appended)]).astype(int).tolist()
        entries = {name: rows[name] for name in info}
        return cls(rows["measurement"], rows["valid"], tuple(dropping), tuple(last), entries)

    @property
    def states(self) -> int:
        """Number of states, for a plant whose info has them."""
        rows = self.info["state"]
        return rows.stop - rows.start if isinstance(rows, slice) else 1

    @property
    def flags(self) -> tuple[int, ...]:
        """Rows of the validity flags that observations have."""
        return tuple(self.valid.start + i for i in self.dropping)

    @property
    def observed(self) -> list[int]:
        """Rows that make the observation: measurements, then validity flags, then what the plant appends."""
        return [*range(self.measurement.start, self.measurement.stop), *self.flags, *self.appended]


def observation_of(values: list[float]) -> np.ndarray:
    """An observation (d,) in float32, infinite where a value is beyond its range or is not a number."""
    values = [value if abs(value) < FLOAT32_ENDS else -math.inf if value < 0 else math.inf for value in values]
    return np.array(values, dtype=np.float32)


def observations_of(report: np.ndarray, observed: list[int], dtype: Any = np.float32) -> np.ndarray:
    """The same of N copies, (N, d), from rows of their report (reported, N)."""
    observations = np.empty((report.shape[1], len(observed)), dtype=dtype)
    with np.errstate(over="ignore"):  # beyond 3.4e38 lies infinity
        for i, row in enumerate(observed):
            observations[:, i] = report[row]
    if np.isnan(observations.sum()):  # of a copy that terminates; a single env reports infinity, too
        observations[np.isnan(observations)] = np.inf
    return observations


def views_of(report: np.ndarray, rows: ReportRows) -> tuple[np.ndarray, ...]:
    """Views of the vectors in a report (reported,) that `info_maker` takes."""
    vectors = [report[index] for index in rows.info.values() if isinstance(index, slice)]
    return (*vectors, report[rows.valid])


def info_maker(rows: ReportRows) -> Callable[[np.ndarray, tuple[np.ndarray, ...]], dict]:
    """Return `info(report, views)`: the info of one copy, in separate arrays.

    It is generated for the plant's entries, because a step has to be fast. Numbers are NumPy scalars, because
    clients ask every value for its dtype.
    """
    layout = tuple((name, None if isinstance(index, slice) else index) for name, index in rows.info.items())
    return _info_maker(layout, bool(rows.dropping))


@cache
def _info_maker(layout: tuple[tuple[str, int | None], ...], drops: bool) -> Callable:
    vectors = [name for name, index in layout if index is None]
    entries = [
        f"{name!r}: views[{vectors.index(name)}].copy()" if index is None else f"{name!r}: report[{index}]"
        for name, index in layout
    ]
    if drops:
        entries.append(f"'measurement_valid': views[{len(vectors)}] > 0.0")
    return written_out("info", "report, views", f"{{{', '.join(entries)}}}")


def infos_of(report: np.ndarray, rows: ReportRows, mask: np.ndarray) -> dict[str, np.ndarray]:
    """The same of N copies: arrays with one row per copy, and the mask (N,) as `_key` for each key."""
    info = {name: report[index].T for name, index in rows.info.items()}
    if rows.dropping:
        info["measurement_valid"] = report[rows.valid].T > 0.0
    return info | {f"_{key}": mask for key in info}


# What `_set_views` makes.
VIEWS = ("_command", "_advance", "_report", "_outcome", "_views", "_info")


def one_number(action, quantity: Quantity) -> float:
    """The command of a plant with one input; ValueError unless an action is one number and not NaN."""
    if type(action) is ndarray and action.size == 1:  # the frequent case has to be quick
        number = action.item()
        if type(number) is float and number == number:
            return number
    try:
        item = action.item if hasattr(action, "item") else np.asarray(action).item
        entry = item()
        number = math.nan if isinstance(entry, (str, bytes)) else float(entry)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # RuntimeError: a torch tensor of several numbers
        number = math.nan
    if number != number:
        raise ValueError(f"an action must be one {quantity.label} and not NaN, but got {short_repr(action)}")
    return number


class PlantEnv(gym.Env):
    """An env of one copy of a plant, whose compiled step does all the computation.

    A plant's env has `inputs` and `page_of`, and calls `_set_up` from its `__init__`. If its `metadata` has modes,
    it defines `make_renderer`, and `moment_of`, the renderer's input from a step's report.
    `thruster_env.env.model_env` offers its model to filters. The vector env is then a class of two lines, see
    `PlantVectorEnv`.

    Attributes:
        inputs: the quantities of the p entries of an action.
        observation_type: dtype of observations.
        plant: the plant; it has `dt`, its sample time [s].
        task: the reward and the end of episodes, if these are a value.
    """

    metadata: dict[str, Any] = {"render_modes": [], "render_fps": 100}
    render_overlay: Callable[[], Any] | None = None  # a filter wrapper's hook: what it shows beside the truth

    inputs: tuple[Quantity, ...]
    observation_type: ClassVar[type] = np.float32
    plant: Any
    task: Any = None
    _renderer: PlantRenderer | None = None

    @staticmethod
    def page_of(plant: Any, task: Any) -> tuple[Page, Any]:
        """The page of a plant with a task, and its parameters; see `thruster_env.env.copies.PlantCopies`."""
        raise NotImplementedError

    def copies_of(self, count: int) -> PlantCopies:
        """Return `count` copies of the plant, with the env's task."""
        return PlantCopies(self.page_of, self.plant, self.task, count)

    def make_renderer(self) -> PlantRenderer:
        """The renderer of this env for its `render_mode`."""
        raise NotImplementedError

    def moment_of(self, report: list[float]) -> tuple:
        """The renderer's input from a report."""
        raise NotImplementedError

    def _by_name(self, report: list[float]) -> dict[str, Any]:
        """The numbers and lists of a report."""
        return {name: report[rows] for name, rows in self._copies.report_rows.items()}

    def _prepare_rendering(self, render_mode: str | None, render_size: Sequence[int] | None = None) -> None:
        modes = self.metadata["render_modes"]
        if render_mode is not None and render_mode not in modes:
            rule = " or ".join(["None", *map(repr, modes)])
            raise ValueError(f"render_mode must be {rule}, but got {render_mode!r}")
        self.render_mode, self.render_size = render_mode, checked_size(render_size)
        self._renderer = None
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / self.plant.dt))}  # true speed

    def render(self) -> np.ndarray | None:
        """Draw the plant: an array (height, width, 3) of uint8 in mode "rgb_array", a window in mode "human"."""
        if self._renderer is None:
            if self.render_mode is None:
                gym.logger.warn("render() draws nothing without a render_mode, given to gym.make")
            return None
        if self.render_overlay is not None:
            self._renderer.amend(self.render_overlay())
        return self._renderer.draw()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def _show(self, report: list[float], *, begin: bool = False) -> None:
        """Add the report of a reset (`begin`) or a step to the renderer, and draw it in a window."""
        if self._renderer is None:
            self._renderer = self.make_renderer()
        if begin:
            self._renderer.begin()
        elif self.render_overlay is not None:
            self._renderer.amend(self.render_overlay())  # of the moment before: the wrapper updates after the step
        self._renderer.add(self.moment_of(report))
        if self.render_mode == "human":
            self._renderer.draw()

    def _set_up(
        self,
        action_space: gym.spaces.Box,
        info: Sequence[str],
        appended: Sequence[str] = (),
        dropping: Sequence[int] = (),
        render_mode: str | None = None,
        render_size: Sequence[int] | None = None,
    ) -> None:
        """Make spaces and memory; `plant` and `task` must be there.

        Args:
            action_space: of shape (p,).
            info: what the info has of a report, in order.
            appended: what the observation has of it after the measurement.
            dropping: channels whose measurements may be missing.
            render_mode: None, or one of the modes in `metadata`.
            render_size: of pictures, (width, height) [px]; 640 x 400 if None.

        Raises:
            ValueError: if there is no such mode, or the size is none.
        """
        self._prepare_rendering(render_mode, render_size)
        self._copies = self.copies_of(1)
        self._rows = rows = ReportRows.of(self._copies.report_rows, info, appended, dropping)
        self._observed, self._readings = rows.observed, rows.observed[0]
        self._single = len(rows.observed) == 1  # the frequent case, which has to be quick
        self._one_input = len(self.inputs) == 1
        self.action_space = action_space
        shape = (len(rows.observed),)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, shape=shape, dtype=self.observation_type)
        self._out = np.zeros((self._copies.reported, 1, 1))
        self._observation_buffer = np.zeros(1, dtype=np.float32)
        self._set_views()

    def _set_views(self) -> None:
        """Views into the memory of the one copy, because a step has to be fast."""
        copies = self._copies
        self._advance: Callable = self._advance_first
        self._command = copies.memory[0, copies.commands.start : copies.commands.stop, 0]
        self._report = self._out.reshape(-1)
        self._outcome = self._report[REWARD : TERMINATED + 1]
        self._views, self._info = views_of(self._report, self._rows), info_maker(self._rows)

    def _advance_first(self) -> None:
        """The first step; later ones call machine code itself."""
        self._advance = self._copies.step_into(self._out)
        self._advance()

    def __getstate__(self) -> dict:
        """The state without its views, for copies and pickles, which continue with the same numbers."""
        return {key: value for key, value in vars(self).items() if key not in VIEWS}

    def __setstate__(self, state: dict) -> None:
        """Make the views on the restored memory."""
        vars(self).update(state)
        self._set_views()

    def __copy__(self) -> PlantEnv:
        """A deep copy, because envs that share a memory would step each other."""
        return copy.deepcopy(self)

    @property
    def report_rows(self) -> ReportRows:
        """The contents of a report, and its rows for observation and info."""
        return self._rows

    @property
    def appended_entries(self) -> int:
        """Entries of the observation after the measurement: validity flags and what the plant appends."""
        return len(self._rows.flags) + len(self._rows.appended)

    @property
    def spec(self):
        """The specification that made this env; its objects are stored as mappings for JSON."""
        return self._spec

    @spec.setter
    def spec(self, spec) -> None:
        if spec is not None:
            spec.kwargs.update({key: as_json(value) for key, value in spec.kwargs.items()})
        self._spec = spec

    _spec = None

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start an episode: a key from the env's generator, an initial state and a first measurement.

        `options={"state": [..]}` fixes the initial state of this episode.
        """
        numbers = self._copies.numbers_from(options)
        super().reset(seed=checked_seed(seed))
        self._report[:] = self._copies.begin(draw_key(self.np_random)[None], numbers=numbers)[:, 0]
        if self.render_mode is not None:
            self._show(self._report.tolist(), begin=True)
        return self._observation(), self._info(self._report, self._views)

    def step(self, action):
        """Apply an action for one sample time.

        Raises ValueError for an action that does not have one number for each input, or contains NaN.
        """
        if self._one_input:
            self._command[0] = one_number(action, self.inputs[0])
        else:
            self._command[:] = some_numbers(action, self.inputs)
        self._advance()
        if self.render_mode is not None:
            self._show(self._report.tolist())
        reward, terminated = self._outcome.tolist()
        return self._observation(), reward, terminated > 0.0, False, self._info(self._report, self._views)

    def _observation(self) -> np.ndarray:
        if self.observation_type is np.float64:
            return self._report[self._observed]
        if self._single:
            reading = self._report.item(self._readings)
            if -FLOAT32_ENDS < reading < FLOAT32_ENDS:
                self._observation_buffer[0] = reading
                return self._observation_buffer.copy()  # twice as fast as a new array of one number
        report = self._report.tolist()
        return observation_of([report[row] for row in self._observed])


MOST_ENVS = 1_000_000  # of some kilobytes each


class PlantVectorEnv(gym.vector.VectorEnv):
    """N copies of an env in one compiled step: copy i after `reset(seed=s)` equals a single env with seed s + i.

    Its j-th later episode equals that env's j-th unseeded reset, in all three autoreset modes. Random parameters
    of an episode are drawn for each copy. Info holds arrays with one row per copy, and a mask `_key` for each key,
    as Gymnasium's own vector envs do. Actions of copies that are about to be reset are ignored.

    Args:
        num_envs: number of copies.
        max_episode_steps: steps after which an episode is truncated; None for never.
        autoreset_mode: "NextStep" (default), "SameStep" or "Disabled", or the `AutoresetMode`.
        **arguments: those of the single env.

    Raises:
        ValueError: if an argument is wrong; the message states the rule and the value.
    """

    single_env: ClassVar[type[PlantEnv]]
    offers: ClassVar[tuple[str, ...]] = ()  # attributes of the single env that it has, too

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **arguments,
    ):
        """Build one env, for its plant and spaces, and the memory of all copies."""
        self.num_envs = at_least("num_envs", num_envs, 1, MOST_ENVS)
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        if arguments.get("render_mode") is not None:
            raise ValueError(f"render_mode must be None in a vector env, but got {arguments['render_mode']!r}")
        env = self.single_env(**arguments)
        self.metadata = {**env.metadata, "autoreset_mode": self.autoreset_mode}
        for name in self.offers:
            setattr(self, name, getattr(env, name))
        self.plant, self.task, self._rows = env.plant, env.task, env.report_rows
        self.inputs = env.inputs
        self._observed = self._rows.observed
        self.appended_entries = env.appended_entries  # of an observation, after the measurement
        self.single_action_space, self.single_observation_space = env.action_space, env.observation_space
        self.action_space = batch_space(env.action_space, self.num_envs)
        self.observation_space = batch_space(env.observation_space, self.num_envs)
        steps = np.inf if max_episode_steps is None else at_least("max_episode_steps", max_episode_steps, 1)
        self._last_time = steps * self.plant.dt
        self._copies = env.copies_of(self.num_envs)
        self._keys = EpisodeKeys(self.num_envs)
        self._done = np.zeros(self.num_envs, dtype=bool)

    def __copy__(self) -> PlantVectorEnv:
        """A deep copy, because envs that share a memory would step each other."""
        return copy.deepcopy(self)

    @property
    def report_rows(self) -> ReportRows:
        """The contents of a report, and its rows for observation and info."""
        return self._rows

    @property
    def bytes_per_copy(self) -> int:
        """Memory of one copy while it is stepped [bytes], without its generator and next keys."""
        return self._copies.bytes_per_copy

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict | None = None):
        """Start an episode of every copy, or of those where `options["reset_mask"]` (num_envs,) is true.

        `options={"state": [..]}` fixes the initial state of these episodes.
        """
        numbers = self._copies.numbers_from(options)
        mask = reset_mask(options, self._keys)
        self._keys.seeds(seed)  # a wrong one changes nothing
        if isinstance(seed, (int, np.integer)):
            self._np_random, self._np_random_seed = np_random(int(seed))
        self._keys.seed(seed, np.ones(self.num_envs, dtype=bool) if mask is None else mask)
        report = self._copies.report()
        which = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask)
        self._restart(which, report, numbers)
        return observations_of(report, self._observed, self.single_env.observation_type), self._info(report, mask)

    def step(self, actions):
        """Apply one action per copy, (num_envs, p), or (num_envs,) if p is 1, for one sample time.

        Raises ValueError for actions of another shape, and for NaN in a copy that is not about to be reset.
        """
        if not self._keys.seeded:
            raise gym.error.ResetNeeded("call reset() before step()")
        ignored = self._done if self.autoreset_mode == AutoresetMode.NEXT_STEP else None
        report = self._copies.step(of_copies(actions, self.num_envs, self.inputs, ignored))
        if self.autoreset_mode == AutoresetMode.NEXT_STEP and self._done.any():
            self._restart(np.flatnonzero(self._done), report)
        terminated, truncated = report[TERMINATED] > 0.0, report[TIME] >= self._last_time
        rewards = report[REWARD]
        self._done = terminated | truncated
        ends = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._done.any():
            rewards = rewards.copy()
            ends = self._endings(report)
            self._restart(np.flatnonzero(self._done), report)
        observations = observations_of(report, self._observed, self.single_env.observation_type)
        return observations, rewards, terminated, truncated, self._info(report) | ends

    def _restart(self, which: np.ndarray, report: np.ndarray, numbers: np.ndarray | None = None) -> None:
        keys = self._keys.draw(which)
        if len(which) == self.num_envs:
            report[:] = self._copies.begin(keys, numbers=numbers)
        else:
            report[:, which] = self._copies.begin(keys, which, numbers)
        report[TERMINATED, which] = 0.0  # a reset ends nothing: what begins beyond limits ends with its first step
        self._done[which] = False

    def _endings(self, report: np.ndarray) -> dict[str, Any]:
        done = self._done.copy()
        observations = observations_of(report, self._observed, self.single_env.observation_type)
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(done):
            final[i] = observations[i]
        info = self._info(report.copy(), done)
        return {"final_obs": final, "_final_obs": done, "final_info": info, "_final_info": done.copy()}

    def _info(self, report: np.ndarray, mask: np.ndarray | None = None) -> dict[str, Any]:
        return infos_of(report, self._rows, np.ones(self.num_envs, dtype=bool) if mask is None else mask)


def _autoreset_mode(mode_or_name) -> AutoresetMode:
    try:
        return AutoresetMode(mode_or_name)
    except ValueError:
        names = ", ".join(repr(mode.value) for mode in AutoresetMode)
        raise ValueError(f"autoreset_mode must be one of {names}, but got {mode_or_name!r}") from None


class ObserveState(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Observe the true state of a plant instead of the measurement.

    Entries that the env appends to its measurement (validity flags, a reference signal) stay at the end.

    Args:
        env: an env of a plant.
    """

    def __init__(self, env: gym.Env):
        """Wrap the env; see the class."""
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        base: Any = env.unwrapped
        self._appended = base.appended_entries
        self.observation_space = _space(base.report_rows.states + self._appended)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Reset the env."""
        observation, info = self.env.reset(seed=seed, options=options)
        return _observed(info["state"], observation, self._appended), info

    def step(self, action):
        """Step the env."""
        observation, *outcome, info = self.env.step(action)
        return _observed(info["state"], observation, self._appended), *outcome, info


class ObserveStateVector(gym.vector.VectorWrapper):
    """`ObserveState` for vector envs, in all three autoreset modes.

    Args:
        env: a vector env of a plant.
    """

    def __init__(self, env: gym.vector.VectorEnv):
        """Wrap the envs; see the class."""
        super().__init__(env)
        base: Any = env.unwrapped
        self._appended = base.appended_entries
        self.single_observation_space = _space(base.report_rows.states + self._appended)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict | None = None):
        """Reset the envs."""
        seeds: Any = seed  # Gymnasium takes a list of them, too, but its annotation does not say so
        observations, info = self.env.reset(seed=seeds, options=options)
        return _observed(info["state"], observations, self._appended), info

    def step(self, actions):
        """Step the envs."""
        observations, *outcome, info = self.env.step(actions)
        if "final_obs" in info:
            for i in np.flatnonzero(info["_final_obs"]):
                last = info["final_info"]["state"][i]
                info["final_obs"][i] = _observed(last, info["final_obs"][i], self._appended)
        return _observed(info["state"], observations, self._appended), *outcome, info


def _space(entries: int) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, shape=(entries,), dtype=np.float32)


def _observed(state: np.ndarray, observation: np.ndarray, appended: int) -> np.ndarray:
    """State (..., n), then the last entries of an observation (..., d), in float32."""
    last_entries = observation[..., observation.shape[-1] - appended :]
    with np.errstate(over="ignore"):  # beyond 3.4e38 lies infinity
        return np.concatenate([state.astype(np.float32), last_entries], axis=-1)
