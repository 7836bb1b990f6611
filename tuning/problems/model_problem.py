"""Problems of a model: `ModelProblem` draws runs from one, `RunsProblem` takes your own runs, of any lengths."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable, Collection, Mapping, Sequence
from inspect import Parameter as SignatureParameter
from inspect import Signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from filters.baselines import OpenLoop
from filters.bounds import gathering_code, has_bound, posterior_variances, sequences_taken
from filters.starts import PRIOR as RUNS_PROBLEM_PRIOR
from filters.starts import begun_at, first_measured
from filters.tuned_file import NOISE, PRIOR
from thruster_env.core.angles import difference
from thruster_env.core.checks import as_floats, short_repr
from thruster_env.core.files import write_whole
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.env.model_env import ModelEnv
from thruster_env.logs.columns import STATE
from thruster_env.logs.log import Log
from thruster_env.model.simulate import simulate
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import errors_of, leading, tangent_of
from tuning.problems.assumed import AssumedProblem, as_argument, rows_argument
from tuning.problems.check import check_quantities
from tuning.problems.data import (
    FIRST_SCORED_STEP,
    Data,
    checked_first_scored_step,
    estimates_in_parts,
)
from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import BOUND, BOUND_OF_ROTATIONS, OPEN_LOOP, Parameter
from tuning.problems.scenario import Excitation, excitation_of

if TYPE_CHECKING:
    from thruster_env.graphs.loops import Loops


UNKNOWN = np.deg2rad(20.0)  # standard deviation of a prior's attitude from which it is none
_known: dict[str, tuple[float, ...]] = {}  # of this process


def begun_if_unknown(model: StateSpaceModel, data: Data) -> Data:
    """The data, whose runs begin where the first measurement says if the model's prior knows no attitude.

    Filters that linearise need one that is near: from above 20 degrees on an axis of a rotation they do.
    """
    rotations = [slice(turn.tangent, turn.tangent + min(turn.size, 3)) for turn in model.turns]
    variances = np.diag(model.prior_cov)
    if not any((variances[part] > UNKNOWN**2).any() for part in rotations):
        return data
    return data._replace(begun=begun_at(model, first_measured(data.measurements)))


def average_bound(model: StateSpaceModel, data: Data, truths: int = 100) -> np.ndarray:
    """Root of the bound's variances (n,), averaged over the scored steps of all runs.

    A minute's work for a model of many substeps, and the same for each command on a problem: it is kept beside
    the machine code, by everything that it follows from.

    Args:
        model: the model that draws the truth; Q must be positive definite.
        data: its inputs are those of the bound, a sequence a run.
        truths: truths drawn for each sequence.
    """
    inputs = np.ascontiguousarray(data.seen.inputs, dtype=np.float64)
    code, sources = gathering_code(model)
    parts = sources, model.digest, data.first_scored, truths, inputs.shape
    counted = b"" if data.counted is None else np.ascontiguousarray(data.counted).tobytes()
    follows_from = repr(parts).encode() + model.numbers.tobytes() + inputs.tobytes() + counted

    def compute() -> np.ndarray:
        variances = posterior_variances(model, inputs, truths=truths)
        if data.counted is None:
            return np.sqrt(data.pooled(variances))
        sequences = sequences_taken(inputs, truths, model)
        if len(sequences) == 1:  # of all sequences, where they are the same
            variances, sequences = np.repeat(variances, len(inputs), axis=0), np.arange(len(inputs))
        return np.sqrt(data._replace(counted=data.counted[sequences]).pooled(variances))

    return cached_numbers("bound", model.t, follows_from, code, compute)


def cached_numbers(name: str, count: int, follows_from: bytes, code: Loops, compute: Callable) -> np.ndarray:
    """Return the vector compute(), from the cache if it was computed from the same inputs before.

    Numbers lie as JSON where machine code is kept (`thruster_env.graphs.machine_code`), for one kind of
    processor, and go with it. A file that is damaged is as if it were not there, a folder that takes none is as it
    is.

    Args:
        name: first part of the file's name.
        count: n, how many numbers there are.
        follows_from: everything that the numbers follow from, also the sources of what computes them.
        code: what computes them, or most of them.
        compute: a function that returns finite numbers (n,); others are not kept.
    """
    from thruster_env.graphs.machine_code import host

    folder = code.folder
    key = hashlib.sha256(follows_from + (host() if folder else "Python").encode()).hexdigest()
    if key not in _known:
        file = None if folder is None else Path(folder) / f"{name}-{key[:32]}.json"
        numbers = None if file is None else _read(file, count)
        if numbers is None:
            numbers = tuple(np.asarray(compute(), dtype=np.float64).tolist())
            if not np.isfinite(numbers).all():
                return np.array(numbers)
            if file is not None:
                with contextlib.suppress(ValueError):  # nothing can be written there
                    write_whole(file, json.dumps(numbers))
        _known[key] = numbers
    return np.array(_known[key])


def _read(file: Path, count: int) -> tuple[float, ...] | None:
    try:
        numbers = tuple(map(float, json.loads(file.read_bytes())))
    except (OSError, TypeError, ValueError):
        return None
    return numbers if len(numbers) == count and np.isfinite(numbers).all() else None


SCALE_SEEDS = range(200)  # seeds of the inputs for which the scale is the bound, where none is given
Inputs = np.ndarray | Sequence | Mapping | Excitation | Callable | None
PARTS = ("inputs", "measurements", "states")


class ModelProblem(AssumedProblem):
    """Data drawn from one state-space model, for filters that assume the same or another one.

    The states whose symbols both models have are compared; they come first in the assumed model. Measurements and
    inputs are the same in both.

    Args:
        truth: the model from which states and measurements are drawn, with the keys of the seeds.
        assumed: the model that filters assume, or a function of `parameters` that makes it; the truth if None.
        inputs: an array (K, p) that all seeds share (or (K,) for one input); an excitation, or a mapping with its
            name ("steps", "prbs", "multi-sine", "dwells"); or a function of (seeds, steps) that returns (B, K, p).
            None for a model without inputs.
        steps: length K of a run; that of the array if None, else 500.
        scale: by which the score divides the error of each state, infinite for states that do not count; if None
            the bound of the true model over 200 seeds, or where Q is singular the RMSE of the open loop.
        first_scored_step, parameters, untuned, true, dt, name, about: those of `AssumedProblem`. The rule of thumb
            has the R of the assumed model, and the oracle the Q and R of the truth, if both have the same states.

    Raises:
        ValueError: if the two models do not fit each other, or an argument is invalid.
    """

    def __init__(
        self,
        truth: StateSpaceModel,
        assumed: StateSpaceModel | Callable[..., StateSpaceModel] | None = None,
        inputs: Inputs = None,
        *,
        steps: int | None = None,
        first_scored_step: int = FIRST_SCORED_STEP,
        scale: Sequence[float] | None = None,
        parameters: Sequence[Parameter] | None = None,
        untuned: Mapping | None = None,
        true: Mapping | None = None,
        dt: float | None = None,
        name: str = "a pair of models",
        about: str = "",
    ):
        """Check that the models fit; see the class for the arguments."""
        if not isinstance(truth, StateSpaceModel):
            raise ValueError(
                f"the truth of problem {name} must be a StateSpaceModel, but it is {short_repr(truth)}"
            )
        self.truth, self.inputs = truth, _checked_inputs(inputs, truth.inputs)
        length = len(self.inputs) if isinstance(self.inputs, np.ndarray) else 500
        super().__init__(
            truth if assumed is None else assumed,
            steps=length if steps is None else steps,
            first_scored_step=first_scored_step,
            scale=scale,
            parameters=parameters,
            untuned=untuned,
            true=true,
            dt=dt,
            name=name,
            about=about,
        )
        if isinstance(self.inputs, np.ndarray) and len(self.inputs) != self.steps:
            raise ValueError(f"inputs must have a row for each of {self.steps} steps, but got {len(self.inputs)}")
        model = self.model()
        for kind in ("input_quantities", "measurements"):
            pair = getattr(model, kind), getattr(truth, kind)
            check_quantities(kind.replace("input_quantities", "inputs"), *pair, "the assumed model", "the truth")
        self._shared = self._shared_states(model)
        if self._true is None and self._shared == list(range(model.n)) and model.n == truth.n:
            r = as_argument(truth.measurement_noise_cov)
            self._true = {"process_noise_cov": rows_argument(truth.process_noise_cov), "measurement_noise_cov": r}

    def _shared_states(self, model: StateSpaceModel) -> list[int]:
        """Indices in the truth of the assumed model's first states."""
        indices = {state.symbol: i for i, state in enumerate(self.truth.states)}
        known = [state.symbol in indices for state in model.states]
        if not known[0] or any(later and not before for before, later in zip(known, known[1:], strict=False)):
            symbols = ", ".join(indices)
            raise ValueError(
                f"states of the assumed model must begin with some of the truth's, {symbols}, "
                f"but got {', '.join(state.symbol for state in model.states)}"
            )
        shared = [indices[state.symbol] for state in model.states if state.symbol in indices]
        pair = model.states[: len(shared)], tuple(self.truth.states[i] for i in shared)
        check_quantities("states", *pair, "the assumed model", "the truth")
        turns = [leading(of.turns, len(shared)) for of in (model, self.truth)]
        if turns[0] != turns[1] or (any(turns) and shared != list(range(len(shared)))):
            raise ValueError(
                "states of the assumed model must begin with those of the truth, with the same rotations, but got "
                f"{', '.join(state.symbol for state in model.states)}"
            )
        return shared

    def make(self, seeds: tuple[int, ...]) -> Data:
        """Truth and measurements under the inputs of each seed."""
        inputs = self._inputs_of(seeds)
        truth = simulate(self.truth, episode_keys(seeds), inputs)
        outputs = {
            symbol: self.truth.output(symbol, truth.states)
            for symbol in self.truth.outputs
            if symbol in self.model().outputs
        }
        states = np.ascontiguousarray(truth.states[..., self._shared])
        data = Data(seeds, inputs, truth.measurements, filter_keys(seeds), self.first_scored_step, states, outputs)
        return begun_if_unknown(self.model(), data)

    def bound(self, data: Data) -> np.ndarray:
        """The posterior Cramér-Rao bound of the truth on these inputs, (n,); NaN where its Q is singular.

        It is averaged over all inputs; for more than twelve states over as many as `posterior_variances` takes.
        Of an angle it is that of wrapped errors (`filters.bounds.wrapped_variances`), of rotations that of small
        ones.
        """
        return self._bound(data)

    def found_scale(self) -> np.ndarray:
        """The bound over 200 seeds or, where there is none, the RMSE of the open loop of the truth."""
        data = self.data(SCALE_SEEDS)
        scale = self._bound(data)
        if np.isnan(scale).any():
            with np.errstate(all="ignore"):
                errors = self._open_loop_errors(data)[:, data.late]
                scale = np.sqrt((errors**2).mean(axis=(0, 1)))
        if not (np.isfinite(scale).all() and (scale > 0).all()):
            raise ValueError(
                f"the scale of problem {self.name} must be given if neither a bound nor the error of the open "
                f"loop is finite and positive in every state, but the latter is {scale.tolist()}"
            )
        return scale

    @property
    def found_scale_about(self) -> str:
        """The default scale: one zero on the diagonal of the true Q rules out the bound."""
        if not has_bound(self.truth.process_noise_cov):
            return f"{OPEN_LOOP}, for the true Q is singular"
        return BOUND_OF_ROTATIONS if self.truth.turns else BOUND

    def _open_loop_errors(self, data: Data) -> np.ndarray:
        """Errors (B, K + 1, n) of the truth's model without measurements."""
        if self.truth.turns:  # whose open loop is the motion without noise
            calm = self.truth.replace(
                process_noise_cov=np.zeros((self.truth.t,) * 2), prior_cov=np.zeros((self.truth.t,) * 2)
            )
            return errors_of(
                self.truth, simulate(calm, np.zeros((len(data.inputs), 2)), data.inputs).states, data.known_states
            )
        angles = [self.truth.shape.state_angles[i] for i in self._shared]
        parts = estimates_in_parts(OpenLoop(model=self.truth), data)
        return np.concatenate(
            [
                difference(estimates.means[..., self._shared], part.known_states, angles)
                for part, estimates in parts
            ]
        )

    def _bound(self, data: Data) -> np.ndarray:
        if not has_bound(self.truth.process_noise_cov):
            return np.full(len(tangent_of(self.truth, len(self._shared))), np.nan)
        bound = average_bound(self.truth, data)
        return bound[: len(tangent_of(self.truth, len(self._shared)))] if self.truth.turns else bound[self._shared]

    def make_env(self, **arguments: Any) -> ModelEnv:
        """The truth as a Gymnasium env, which offers filters the assumed model; the data of a seed is its episode.

        Args:
            **arguments: `low` and `high` of the inputs, as `ModelEnv` takes them; by default those of the
                problem's inputs, where these are an excitation that tells them, or an array; others have none.
        """
        low, high = self._limits()
        return ModelEnv(self.truth, NamedArguments(self), dt=self._dt, **{"low": low, "high": high, **arguments})

    env = make_env  # its name before there was one for all problems

    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest of each input, as far as the problem's inputs tell; none where one stands still."""
        ends = None
        if isinstance(self.inputs, Excitation):
            ends = self.inputs.limits(self.truth.inputs)
        elif isinstance(self.inputs, np.ndarray):
            ends = self.inputs.min(axis=0), self.inputs.max(axis=0)
        low, high = (0.0, 0.0) if ends is None else ends
        moves = np.broadcast_to(np.less(low, high), self.truth.inputs)
        return np.where(moves, low, -np.inf), np.where(moves, high, np.inf)

    def _inputs_of(self, seeds: tuple[int, ...]) -> np.ndarray:
        shape = len(seeds), self.steps, self.truth.inputs
        if self.inputs is None:
            return np.zeros(shape)
        if isinstance(self.inputs, Excitation):
            return self.inputs.inputs(episode_keys(seeds), self.steps, self._dt or 1.0, self.truth.inputs)
        if isinstance(self.inputs, np.ndarray):
            return np.ascontiguousarray(np.broadcast_to(self.inputs, shape))
        inputs = as_floats(self.inputs(seeds, self.steps)).copy()
        if inputs.shape != shape:
            raise ValueError(f"inputs of problem {self.name} must have the shape {shape}, but got {inputs.shape}")
        return inputs


class NamedArguments:
    """A problem's `model` with a signature that names its arguments."""

    def __init__(self, problem: AssumedProblem):
        """Take the problem."""
        self._problem = problem

    @property
    def __signature__(self) -> Signature:
        """Q, R, the factor on P_0 and the problem's parameters."""
        names = *NOISE, PRIOR, *(parameter.name for parameter in self._problem.parameters or ())
        return Signature(
            [SignatureParameter(name, SignatureParameter.KEYWORD_ONLY, default=None) for name in names]
        )

    def __call__(self, **changes) -> StateSpaceModel:
        """The model with some changes."""
        return self._problem.model(**changes)


def _checked_inputs(inputs: Inputs, count: int) -> np.ndarray | Excitation | Callable | None:
    """The inputs as an array (K, p), an excitation or a function; ValueError for others."""
    if inputs is None and count == 0:
        return None
    if isinstance(inputs, Excitation | Mapping):
        return excitation_of(inputs)
    if callable(inputs):
        return inputs
    try:
        array = as_floats(inputs).copy()
        array = array[:, None] if array.ndim == 1 and count == 1 else array
        if array.ndim != 2 or array.shape[1] != count or not len(array) or not np.isfinite(array).all():
            raise ValueError
    except (TypeError, ValueError):
        rule = f"inputs must be finite numbers (K, {count}), an excitation, or a function of (seeds, steps)"
        raise ValueError(f"{rule}, but got {short_repr(inputs)}") from None
    return array


class RunsProblem(LogProblem):
    """Runs as arrays, each of which begins where the model's prior does; the seed of a run is its number.

    Every third run of three or more is held out; of those with truth every third of the others is for the choice
    of an ensemble size. Each run counts in full: errors are pooled over all scored steps of all runs.

    Args:
        runs: a mapping each with `measurements` (K + 1, m), NaN where missing, `inputs` (K, p), unless the model
            has none, and `states` (K + 1, n) where they are known, NaN in rows where they are not, which are not
            scored; or these as a tuple (inputs, measurements) or (inputs, measurements, states). K may differ.
        model: the model that filters assume, or a function of `parameters` that makes it.
        first_scored_step: rows at the beginning of each run that are not scored.
        held_out: numbers of the held-out runs, from 0.
        start: that of `LogProblem`.
        dt: sample time [s].
        scale, parameters, untuned, name, about: those of `LogProblem`.

    Raises:
        ValueError: states the rule and the value.
    """

    seed_word = "runs"

    def __init__(
        self,
        runs: Sequence[Mapping | Sequence],
        model: StateSpaceModel | Callable[..., StateSpaceModel],
        *,
        first_scored_step: int = 0,
        held_out: Collection[int] | None = None,
        dt: float = 1.0,
        start: str = RUNS_PROBLEM_PRIOR,
        scale: Sequence[float] | None = None,
        parameters: Sequence[Parameter] | None = None,
        untuned: Mapping | None = None,
        name: str = "some runs",
        about: str = "",
    ):
        """Check the arrays; see the class for the arguments."""
        if not isinstance(runs, Sequence) or isinstance(runs, str) or not runs:
            raise ValueError(
                f"runs must be a list of runs, each a mapping or a tuple of arrays, but got {short_repr(runs)}"
            )
        assumed = model if isinstance(model, StateSpaceModel) else _made(model, parameters)
        logs = [log_of(run, assumed, dt, f"run {i}") for i, run in enumerate(runs)]
        super().__init__(
            logs,
            model,
            lead=checked_first_scored_step(first_scored_step, max(log.steps for log in logs)),
            blocks=1,
            held_out=None if held_out is None else [f"run {i}" for i in held_out],
            shortest=1,
            start=start,
            scale=scale,
            parameters=parameters,
            untuned=untuned,
            name=name,
            about=about,
        )

    @property
    def counts_start_up(self) -> bool:
        """Whether the first steps are scored, on which P_0 has an effect."""
        return self.first_scored_step < FIRST_SCORED_STEP and bool(self.model().prior_cov.any())


def _made(model: Any, parameters: Sequence[Parameter] | None) -> StateSpaceModel:
    """The model of a function at the starts of its parameters, of which inputs and measurements are needed."""
    assumed = (
        model(**{parameter.name: parameter.start for parameter in parameters or ()}) if callable(model) else model
    )
    if not isinstance(assumed, StateSpaceModel):
        raise ValueError(
            f"model must be a StateSpaceModel, or a function that makes one, but got {short_repr(model)}"
        )
    return assumed


def log_of(run: Mapping | Sequence, model: StateSpaceModel, dt: float = 1.0, name: str = "run") -> Log:
    """A run of arrays as a `Log`, whose channels are those of a model.

    Args:
        run: as `RunsProblem` takes it.
        model: whose inputs, measurements and states they are.
        dt: sample time [s].
        name: of the run.

    Raises:
        ValueError: states the rule and the value.
    """
    if not isinstance(run, Mapping):
        parts = tuple(run) if isinstance(run, Sequence) and not isinstance(run, str) else ()
        if len(parts) not in (2, 3):
            raise ValueError(
                f"{name} must be (inputs, measurements) or (inputs, measurements, states), "
                f"but got {short_repr(run)}"
            )
        run = dict(zip(PARTS, parts, strict=False))
    unknown = [key for key in run if key not in PARTS]
    if unknown or run.get("measurements") is None:
        got = short_repr(unknown[0]) if unknown else "no measurements"
        raise ValueError(f"{name} must have measurements, and may have inputs and states, but got {got}")
    measurements = _columns("measurements", run["measurements"], model.channels, name)
    user_inputs = run.get("inputs")
    inputs = (
        np.zeros((len(measurements) - 1, 0))
        if user_inputs is None
        else _columns("inputs", user_inputs, model.inputs, name)
    )
    references, referred = {}, {}
    if run.get("states") is not None:
        states = _columns("states", run["states"], model.n, name)
        for i, state in enumerate(model.states):
            references[f"{STATE}:{state.symbol}"], referred[f"{STATE}:{state.symbol}"] = states[:, i], state
    if inputs.shape != (len(measurements) - 1, model.inputs):
        raise ValueError(
            f"inputs of {name} must have one row fewer than its measurements and one column per input, "
            f"{(len(measurements) - 1, model.inputs)}, but got {inputs.shape}"
        )
    return Log(name, dt, inputs, measurements, model.input_quantities, model.measurements, references, referred)


def _columns(what: str, values: Any, count: int, name: str) -> np.ndarray:
    """Numbers as (rows, count); a single column may be (rows,)."""
    array = as_floats(values)
    array = array[:, None] if array.ndim == 1 and count == 1 else array
    if array.ndim != 2 or array.shape[1] != count:
        raise ValueError(f"{what} of {name} must have {count} columns, as the model has, but got {array.shape}")
    return array
