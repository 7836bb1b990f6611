"""`Plan`, the definition of a study, and the objectives that it minimises.

Two studies with the same plan are the same study. A plan also states the ranges of its parameters in words, and
warns of parameters that ended at an end of their range.

Sources of objectives: for NEES and NIS, the normalised squares of
estimation errors and innovations, Chen, Heckman, Julier, Ahmed (2018), arXiv 1807.08855 (`nees`, `nis`), and Chen,
Biggie, Ahmed, Julier, Heckman, arXiv 2306.07225 (`c-nees`, `c-nis`); Abbeel, Coates, Montemerlo, Ng, Thrun (2005),
"Discriminative training of Kalman filters", Robotics: Science and Systems (`mse`, `log-score`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import log
from typing import Any, NamedTuple

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, IntDistribution

from filters.registry import filter_type
from filters.tuned_file import NOISE
from thruster_env.core.checks import in_words, one_of, positive, short_repr
from thruster_env.core.modules import is_code
from tuning.evaluation.evaluate import Evaluation, mse
from tuning.evaluation.runs import outputs_of
from tuning.problems.assumed import may_estimate_constants
from tuning.problems.check import checked_problem, data_of, digest_of
from tuning.problems.data import Data, estimates_on
from tuning.problems.problem import Argument, Parameter, Problem
from tuning.search.parameters import MeasurementVariance, ProcessVariance, filter_parameters, index_pairs
from tuning.search.space import (
    AUTO,
    AUTO_FILTER_TYPES,
    FILTER_TYPE,
    TOLERANCE,
    Choice,
    choice_of,
    fits,
    forgetting,
    has_search_space,
    joint_parameters,
    raised_noise,
    reachable,
    untuned_choice,
)

NIS_BAND = (0.8, 1.25)  # of the mean NIS over its expected value: a constrained study calls this consistent
MOST_PRICE = 0.05  # of the score, that a mean NIS within its band may cost
DIVERGENCE_PENALTY = 10.0  # added for each filter reset
LARGEST = 1e6  # larger errors are clipped to this: studies need finite numbers
OUTPUT = "output:"  # prefix of objectives on derived outputs
SCORE, MSE, LOG_SCORE, LIKELIHOOD = "score", "mse", "log-score", "likelihood"
PROPER = (
    LOG_SCORE,
    LIKELIHOOD,
)  # sums of logarithms, of which differences count: proper scores of mean and covariance
TRUTH, COVARIANCE, NEES, LOG_SCORES, VARIANCES = "truth", "covariance", "nees", "log scores", "variances"


class Objective(NamedTuple):
    """One number to minimise."""

    about: str
    value: Callable[[Evaluation, float], float]  # of an evaluation and its us/step
    needs: tuple[str, ...] = ()  # of TRUTH, COVARIANCE, NEES, LOG_SCORES, VARIANCES
    output: str = ""  # symbol of the derived output that it needs


def nis_ratio(evaluation: Evaluation) -> float:
    """The mean NIS over the mean number of measured channels: expected value 1; NaN without a covariance."""
    return evaluation.nis.value / evaluation.expected_nis


def nees_ratio(evaluation: Evaluation) -> float:
    """The mean NEES over the number of states: expected value 1; NaN without truth or without a covariance."""
    return evaluation.nees.value / len(evaluation.rmse)


def _from_one(*ratios: Callable[[Evaluation], float]) -> Callable[[Evaluation, float], float]:
    """The sum of |log| of ratios whose expected value is 1, as a function of an evaluation; infinite for none."""

    def value(evaluation: Evaluation, _: float) -> float:
        values = [ratio(evaluation) for ratio in ratios]
        return sum(abs(math.log(ratio)) for ratio in values) if all(ratio > 0.0 for ratio in values) else math.inf

    return value


def output_objective(symbol: str, about: str = "") -> Objective:
    """The RMSE of a derived output of the model, in its unit."""
    return Objective(
        about or f"RMSE of the output {symbol}",
        lambda evaluation, _: evaluation.output_rmse[symbol].value,
        (TRUTH,),
        symbol,
    )


OBJECTIVES = {
    SCORE: Objective(
        "mean over states of RMSE over the scenario's scale [-]", lambda e, _: e.score.value, (TRUTH,)
    ),
    MSE: Objective(
        "sum over states of mean square error over the scenario's scale squared [-]",
        lambda e, _: mse(e.mean_squares, e.scale, e.weights),
        (TRUTH,),
    ),
    LOG_SCORE: Objective(
        "negative log score of the true state, -log N(x; x^, P), mean a step [nat]",
        lambda e, _: -e.log_score.value,
        (TRUTH, COVARIANCE, LOG_SCORES),
    ),
    "thrust": output_objective("T", "RMSE of thrust [N]"),
    LIKELIHOOD: Objective(
        "negative log-likelihood of the innovations, a run", lambda e, _: -e.log_likelihood, (COVARIANCE,)
    ),
    "nis": Objective("|log(mean NIS / m)|", _from_one(nis_ratio), (COVARIANCE,)),
    "c-nis": Objective(
        "|log(mean NIS / m)| + |log(variance of the NIS / 2 m)|",
        _from_one(nis_ratio, lambda e: e.nis_variance),
        (COVARIANCE, VARIANCES),
    ),
    "nees": Objective("|log(mean NEES / n)|", _from_one(nees_ratio), (TRUTH, COVARIANCE, NEES)),
    "c-nees": Objective(
        "|log(mean NEES / n)| + |log(variance of the NEES / 2 n)|",
        _from_one(nees_ratio, lambda e: e.nees_variance),
        (TRUTH, COVARIANCE, NEES, VARIANCES),
    ),
    "consistency": Objective(
        "|log(mean NEES / n)| + |log(mean NIS / m)|", _from_one(nees_ratio, nis_ratio), (TRUTH, COVARIANCE, NEES)
    ),
    "cost": Objective("microseconds a step of one run, of one core", lambda _, microseconds: microseconds),
}


def find_objective(name: str) -> Objective:
    """An objective by name, "output:SYMBOL" for that of a derived output; ValueError for an unknown one."""
    if isinstance(name, str) and name.startswith(OUTPUT) and name != OUTPUT:
        return output_objective(name.removeprefix(OUTPUT))
    return OBJECTIVES[one_of("objective", name, (*OBJECTIVES, f"{OUTPUT}SYMBOL"))]


def reported(name: str, value: float) -> float:
    """The value of an objective in reports: log L and the log score themselves, not the minimised negative."""
    return -value if name in PROPER else value


def reported_name(name: str) -> str:
    """The name of what `reported` returns."""
    return {LIKELIHOOD: "log L", LOG_SCORE: "log score"}.get(name, name)


def penalised(value: float, evaluation: Evaluation) -> float:
    """A finite value for a study; it is large for a filter that diverged."""
    value = min(value, LARGEST) if value == value else LARGEST
    return value + DIVERGENCE_PENALTY * evaluation.divergences


def nis_violation(evaluation: Evaluation) -> float:
    """Logarithmic distance of the mean NIS from its band; at most zero inside, as Optuna expects it."""
    low, high = NIS_BAND
    ratio = nis_ratio(evaluation)
    if not ratio > 0.0 or not math.isfinite(ratio):
        return LARGEST
    return max(math.log(low / ratio), math.log(ratio / high))


TRAINING_SEEDS = 32
HELD_OUT_SEEDS = 200
VALIDATION_SEEDS = 100  # on which the best trials meet the baselines
SIZE_SEEDS = 100  # enough to distinguish an ensemble that is 1 % worse than the best, as N = 30 from N = 50
MOST_OPTIONS = 3  # in a sentence
FEW = 50  # steps, along which a user's estimator is identified
WIDER = 1e4  # factor by which a range is widened, on the advice of a report
NEAR_END = 0.01  # of a range, on its scale: what ends so near to an end has ended there


def check_objectives(names: Iterable[str], problem: Problem) -> None:
    """Raise ValueError if an objective needs the truth, or a derived output, that a problem does not have."""
    for name in names:
        objective = find_objective(name)
        if TRUTH in objective.needs and problem.scale is None:
            free = ", ".join(known for known, objective in OBJECTIVES.items() if TRUTH not in objective.needs)
            raise ValueError(
                f"an objective on {problem.name}, which has no truth, must be one of {free}, "
                f"but got {short_repr(name)}"
            )
        outputs = tuple(outputs_of(problem.model())) if objective.output else ()
        if objective.output and objective.output not in outputs:
            has = ", ".join(f"{OUTPUT}{symbol}" for symbol in outputs) or "none"
            raise ValueError(
                f"an objective on a derived output of {problem.name} must be one of {has}, "
                f"but got {short_repr(name)}"
            )


def joint_distributions(filter_types: Sequence[str], problem: Problem, **options) -> dict[str, BaseDistribution]:
    """The ranges of `joint_parameters`, as Optuna takes them; of several filter types, "filter" comes first."""
    space: dict[str, BaseDistribution] = {}
    if len(filter_types) > 1:
        space[FILTER_TYPE] = CategoricalDistribution(filter_types)
    return space | {
        key: parameter.distribution
        for key, parameter in joint_parameters(filter_types, problem, **options).items()
    }


class Plan(NamedTuple):
    """A filter, what to tune it on, what to minimise and how to search."""

    filter: str  # a name, or "auto" for the best of many filter types
    scenarios: tuple[Problem, ...]
    seed: int = 0
    objectives: tuple[str, ...] = ("score",)
    consistent: bool = True  # whether the mean NIS has to be within its band
    sampler: str = "tpe"
    hold_r: bool = False  # whether R stays that of the sensor's data sheet
    prune: bool = True  # whether a trial is pruned that is worse than the best one on the same seeds
    budget: float | None = None  # us/step that the filter may take, as `cost.microseconds_a_step` measures them
    full_q: bool = False  # whether Q has correlations; of own parameters whether noise estimation's Q competes
    full_r: bool = False  # whether R has correlations, of one channel none; the same
    worst: bool = False  # of several problems the worst one counts, and not their mean
    where: tuple[str, ...] = ()  # relations among the numbers of the model, such as "Q22 = 4 Q11"
    forget: float | None = None  # the longest time constant of the gain that is allowed [s]
    ensemble_size: int | None = None  # N of the filter, where it is not tuned

    @property
    def identity(self) -> dict:
        """What must be the same for a study to be continued, including the estimates of a user's own estimator."""
        digests = {name: self._digest_of_code(name) for name in self.filter_types if is_code(name)}
        return {
            **({"estimators": digests} if digests else {}),
            **({"worst": True} if self.worst else {}),
            **({"full_r": True} if self.full_r else {}),
            **({"where": list(self.where)} if self.where else {}),
            **({} if self.forget is None else {"forget": self.forget}),
            **({} if self.ensemble_size is None else {"ensemble_size": self.ensemble_size}),
            "filter": self.filter,
            "kinds": list(self.filter_types),
            "budget": self.budget,
            "full_q": self.full_q,
            "scenarios": [scenario.name for scenario in self.scenarios],
            "scenario_digests": [scenario.digest for scenario in self.scenarios],
            "seed": self.seed,
            "objectives": list(self.objectives),
            "consistent": self.consistent,
            "sampler": self.sampler,
            "hold_r": self.hold_r,
            "optuna": optuna.__version__.split(".")[0],
        }

    def _digest_of_code(self, name: str) -> str:
        """A hash of an estimator's estimates as a run begins, at the defaults and ends of its parameters."""
        problem = self.scenarios[0]
        estimates: list[Any] = []
        run = problem.data(tuple(problem.training_seeds(self.seed, 2))[:1]).seen
        first = Data(run.seeds, run.inputs[:, :FEW], run.measurements[:, : FEW + 1], run.filter_keys)
        free = filter_parameters(filter_type(name), process_noise=False)
        choices = [untuned_choice(name, problem)] * 3
        for parameter in free:
            choices[1:] = parameter.set(choices[1], parameter.low), parameter.set(choices[2], parameter.high)
        for choice in choices:
            try:
                estimates += estimates_on(choice.filter(problem), first)[:2]  # means and covariances
            except ValueError as error:  # which a trial would raise, too
                estimates.append(str(error))
        return digest_of(*estimates)

    @property
    def filter_types(self) -> tuple[str, ...]:
        """Names of the filters among which a trial chooses."""
        if self.filter != AUTO:
            return (self.filter,)
        return tuple(name for name in AUTO_FILTER_TYPES if all(fits(name, problem) for problem in self.scenarios))

    @property
    def is_constrained(self) -> bool:
        """Whether the mean NIS has to be within its band.

        A filter without a covariance has no NIS, and the log score needs no band: P counts in it.
        """
        return self.consistent and self._has_covariance and self.objectives[0] != LOG_SCORE

    @property
    def rescales(self) -> bool:
        """Whether Q and R may be multiplied by a common factor to make a filter consistent."""
        return self.is_constrained and not self.hold_r and self.tunes_noise

    @property
    def _has_covariance(self) -> bool:
        return all(filter_type(name).has_covariance for name in self.filter_types)

    @property
    def asks_for_cost(self) -> bool:
        """Whether the cost of a step has to be measured."""
        return self.budget is not None or "cost" in self.objectives

    def checked(self) -> Plan:
        """The same plan; ValueError for one that cannot work."""
        if not all(map(has_search_space, self.filter_types)):
            raise ValueError(f"filter must have something to tune, but got {self.filter!r}")
        if not self.scenarios:
            raise ValueError("a study must have at least one scenario, but got none")
        self._check_problems()
        if not 1 <= len(self.objectives) <= 2 or len(set(self.objectives)) < len(self.objectives):
            raise ValueError(f"objectives must be one, or two different ones, but got {list(self.objectives)}")
        for name, objective in zip(self.objectives, self.found_objectives(), strict=True):
            if COVARIANCE in objective.needs and not self._has_covariance:
                raise ValueError(
                    f"the objective {name!r} needs a filter with a covariance, but got {self.filter!r}"
                )
        for problem in self.scenarios:
            check_objectives(self.objectives, problem)
        parameters = self.scenarios[0].parameters
        if parameters is not None and (self.hold_r or (self.full_r and not self.full_q)):
            names = ", ".join(parameter.name for parameter in parameters)
            raise ValueError(
                f"a held R, or a full R without a full Q, needs a problem that tunes Q and R, but "
                f"{self.scenarios[0].name} tunes {names}"
            )
        if self.full_q and not self._has_covariance:
            raise ValueError(f"a full Q needs a filter with a covariance, but got {self.filter!r}")
        if self.full_r and parameters is None:
            self._check_full_r()
        if self.where and not self._has_covariance:
            raise ValueError(f"relations need a filter with a covariance, but got {self.filter!r}")
        self.space()  # relations are checked
        if self.forget is not None:
            self._check_forget(positive("forget", self.forget))
        if self.budget is not None:
            positive("budget", self.budget)
        elif self.filter == AUTO and "cost" not in self.objectives:
            raise ValueError(
                "a study of filter 'auto' must have a budget of microseconds a step (an ekf takes about 0.1, an "
                "enkf of 30 members 0.7, a pf of 1000 particles 20) or the objective 'cost', but got neither"
            )
        return self

    def _check_forget(self, seconds: float) -> None:
        """Raise ValueError unless Q can be raised so that the filter forgets in time."""
        if not self._has_covariance:
            raise ValueError(f"forget (--forget) needs a filter with a Q, but got {self.filter!r}")
        for problem in self.scenarios:
            if problem.dt is None:
                raise ValueError(f"forget (--forget) needs a sample time, but {problem.name} has none")
            if seconds < problem.dt:
                raise ValueError(f"forget must be at least the sample time, {problem.dt:g} s, but got {seconds:g}")
        if len({problem.model().n for problem in self.scenarios}) > 1:
            raise ValueError("forget (--forget) needs problems with the same number of states")
        choice = untuned_choice(self.filter_types[0], self.scenarios[0])
        for problem in self.scenarios:
            raised = raised_noise(choice, problem, self.seed, seconds)
            if raised is not None and raised.steps * (problem.dt or 1.0) > TOLERANCE * seconds:
                other = reachable(choice.name, problem, self.seed, seconds)
                advice = "measure more" if other is None else f"allow a longer one, such as {other:g} s"
                raise ValueError(
                    f"a time constant (--forget) must be one that a larger Q reaches, but on {problem.name} none "
                    f"reaches {seconds:g} s: {advice}"
                )

    def _check_full_r(self) -> None:
        if self.hold_r:
            raise ValueError("R must be free to be full, but got hold_r (--hold-r) with full_r (--full-r)")
        if not self._has_covariance:
            raise ValueError(f"a full R needs a filter with a covariance, but got {self.filter!r}")

    def _check_problems(self) -> None:
        """Raise ValueError unless all scenarios are problems, and the same parameters have a meaning for each."""
        shapes = []
        for problem in self.scenarios:
            if not isinstance(problem, Problem):
                raise ValueError(
                    f"a study must be of tuning.problems.problem.Problem, but got {short_repr(problem)}"
                )
            checked_problem(problem)
            parameters = [parameter.name for parameter in problem.parameters or ()]
            sizes = () if parameters else (len(problem.errors), len(problem.innovations))
            shapes.append((sizes, parameters))
            if shapes[-1] != shapes[0]:
                raise ValueError(
                    "problems of one study must have the same numbers of states and measurements, or the "
                    f"same parameters of their own, but {self.scenarios[0].name} and {problem.name} do not"
                )
        names = [problem.name for problem in self.scenarios]
        if len(set(names)) < len(names):
            raise ValueError(f"problems of one study must have different names, but got {', '.join(names)}")

    def found_objectives(self) -> list[Objective]:
        """The objectives themselves."""
        return [find_objective(name) for name in self.objectives]

    def space(self) -> dict[str, BaseDistribution]:
        """The distributions of a trial's parameters by name; ranges are those of the first scenario.

        The scale of P_0 is one of them where a scenario scores the start-up.
        """
        distributions = joint_distributions(self.filter_types, self.scenarios[0], **self.options)
        if self.ensemble_size is not None and "N" in distributions:
            distributions["N"] = IntDistribution(self.ensemble_size, self.ensemble_size)
        return distributions

    def parameters(self) -> dict[str, Parameter]:
        """A trial's parameters by name, without the filter type."""
        return joint_parameters(self.filter_types, self.scenarios[0], **self.options)

    def first_ranges(self) -> dict[str, tuple[float, float]]:
        """The parts of the ranges of Q and R in which a search begins, by name."""
        return {
            name: parameter.first for name, parameter in self.parameters().items() if parameter.first is not None
        }

    @property
    def tunes_noise(self) -> bool:
        """Whether Q and R are tuned: the problem has no parameters of its own, the filters a covariance."""
        return self.scenarios[0].parameters is None and self._has_covariance

    @property
    def options(self) -> dict[str, Any]:
        """The tuned parts of the model, as arguments of `model_parameters`."""
        prior = self.tunes_noise and any(scenario.counts_start_up for scenario in self.scenarios)
        tuned = {"hold_r": self.hold_r, "full_q": self.full_q, "full_r": self.full_r, "prior": prior}
        return {**tuned, "where": self.where}

    def choice_of(self, values: Mapping[str, Any]) -> Choice:
        """The choice of a trial's parameters."""
        return self.forgetting(choice_of(self.filter, values, self.scenarios[0], self.where))

    def forgetting(self, choice: Choice, *, exact: bool = False) -> Choice:
        """The choice with a Q that is raised, where it has to be, to keep time constants below `forget`.

        They are those of the steady gain; if exact, those of the filter's own gain, which results state.
        """
        if self.forget is None:
            return choice
        return forgetting(choice, self.scenarios, self.seed, self.forget, exact=exact)

    def training_data(self) -> list[Data]:
        """Data that all trials share, one for each scenario."""
        return [data_of(problem, problem.training_seeds(self.seed, TRAINING_SEEDS)) for problem in self.scenarios]

    def validation_data(self) -> list[Data]:
        """Data on which the best trials are compared with the baselines, one for each scenario."""
        return [problem.data(problem.validation_seeds(self.seed, VALIDATION_SEEDS)) for problem in self.scenarios]

    def size_data(self) -> list[Data]:
        """Data that choose the ensemble size once Q and R are chosen, one for each scenario."""
        return [data_of(problem, problem.size_seeds(self.seed, SIZE_SEEDS)) for problem in self.scenarios]


def model_ranges(plan: Plan) -> dict[str, Parameter]:
    """The parameters of the model that a study chooses, by name."""
    return {name: parameter for name, parameter in plan.parameters().items() if _is_of_model(parameter)}


def range_words(plan: Plan) -> str:
    """The ranges of the model's parameters in words; empty if none is chosen."""
    parts = [
        f"{index_pairs(name)} {parameter.low:.3g} to {parameter.high:.3g} {parameter.unit}".rstrip()
        for name, parameter in model_ranges(plan).items()
    ]
    return "; ".join(parts)


class Ended(NamedTuple):
    """A parameter of a choice at an end of its range."""

    name: str
    parameter: Parameter
    value: float
    low: bool  # whether it is the lower end

    @property
    def wider(self) -> str:
        """The option that widens the range at that end."""
        parameter = self.parameter
        ends = (parameter.low / WIDER, parameter.high) if self.low else (parameter.low, parameter.high * WIDER)
        return f"--where '{self.name} = {ends[0]:.3g}..{ends[1]:.3g}'"


def at_ends(choice: Choice, plan: Plan) -> list[str]:
    """A sentence for each parameter of a choice at an end of its range, with advice."""
    sentences = []
    for reached in _ended(choice, plan):
        parameter, end = reached.parameter, "lower" if reached.low else "upper"
        ends = f"{parameter.low:.3g} to {parameter.high:.3g} {parameter.unit}".rstrip()
        ended = f"{index_pairs(reached.name)} = {reached.value:.3g} ended at the {end} end of its range, {ends}"
        sentences.append(f"{ended}: {_advice(reached, plan)}.")
    return sentences


def _ended(choice: Choice, plan: Plan) -> list[Ended]:
    """The parameters of a choice at an end of their range.

    Given values are not ends, nor are parameters that do not determine the choice's Q and R, nor a Q that
    `--forget` may have raised.
    """
    user_values: Mapping = plan.scenarios[0].given or {}
    own_noise = plan.scenarios[0].parameters is not None and bool(set(NOISE) & set(choice.model))
    reached = []
    for name, parameter in model_ranges(plan).items():
        value, raised = (
            parameter.get(choice),
            plan.forget is not None and isinstance(parameter.place, ProcessVariance),
        )
        if value is None or own_noise or raised or value <= 0 < parameter.low:
            continue
        if value == _given_value(parameter, choice, user_values):
            continue
        part = _part(value, parameter)
        if not NEAR_END < part < 1.0 - NEAR_END:
            reached.append(Ended(name, parameter, value, part <= NEAR_END))
    return reached


def range_warning(choice: Choice, plan: Plan) -> list[str]:
    """The end of the search in a sentence, in a list, if Q or R of a choice is as large as its range allows.

    If the Q and R from which the ranges follow are far too small, the filter looks as if its model were wrong.
    """
    high = [
        reached
        for reached in _ended(choice, plan)
        if not reached.low and not isinstance(reached.parameter.place, Argument)
    ]
    if not high:
        return []
    names, more = [index_pairs(reached.name) for reached in high], len(high) - MOST_OPTIONS
    options = " ".join(reached.wider for reached in high[:MOST_OPTIONS]) + (
        f" and {more} more" if more > 0 else ""
    )
    ends = "the upper end of its range" if len(names) == 1 else "the upper ends of their ranges"
    return [
        f"{in_words(names)} ended at {ends}, given by the Q and R with which the study began. Before you doubt "
        f"the model, widen the range: {options}."
    ]


def _is_of_model(parameter: Parameter) -> bool:
    return isinstance(parameter.place, ProcessVariance | MeasurementVariance | Argument)


def _given_value(parameter: Parameter, choice: Choice, user_values: Mapping) -> float | None:
    return parameter.get(choice._replace(model=dict(user_values))) if user_values else None


def _part(value: float, parameter: Parameter) -> float:
    """Where a value lies in its range, from 0 to 1 on the range's scale."""
    if parameter.log:
        return (log(value) - log(parameter.low)) / (log(parameter.high) - log(parameter.low))
    return (value - parameter.low) / (parameter.high - parameter.low)


def _advice(reached: Ended, plan: Plan) -> str:
    """What to do about a parameter at an end of its range."""
    location, low = reached.parameter.place, reached.low
    if isinstance(location, Argument):
        return f"give its Parameter a {'lower low' if low else 'higher high'}, if that has a meaning"
    if isinstance(location, ProcessVariance):
        if low:
            return "the data do not require this noise, and it may be zero"
        cause = "the model lacks something there: repair it"
        if may_estimate_constants(plan.scenarios[0]):
            cause += ", or estimate a constant (--augment NAME)"
    elif low:
        cause = "the sensor is better than its data sheet, or its readings are smoothed: keep R with --hold-r"
    else:
        cause = "the sensor is far worse than its sheet, or stuck, or its model is wrong: look at its readings"
    return f"widen the range ({reached.wider}). If it ends at the new end, too, {cause}"
