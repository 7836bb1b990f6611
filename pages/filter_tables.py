"""The tables of docs/filters.md that hold computed numbers, as Markdown: `TABLES` has them by name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from filters import FILTERS, StateSpaceModel, Unknown, augmented_model, make_filter, thruster_model
from filters.filter import Filter
from filters.registry import filter_type
from pages.filter_noise import LOUD, outliers
from pages.filter_runs import PUBLISHED_NOISE, Runs, errors_of, held_runs
from pages.filter_sampled import SIGNLESS, signless_runs
from pages.page import digits
from thruster_env.core.compiled import interpreted
from thruster_env.core.text_tables import markdown_table


class Words(NamedTuple):
    """Properties of a filter that are not computed."""

    assumes: str  # beyond known Q and R
    belief: str
    ratio: str  # time of a step in a batch over that of "ekf", rounded; `make bench` measures times
    fails: str


WORDS = {
    "kf": Words("affine f and h, or nearly so around an operating point", "mean, P", "1", "away from that point"),
    "kf-steady": Words("the same, and gaps are rare", "mean; P is for reports", "1", "as `kf`; start-up"),
    "ekf": Words("f and h nearly linear within P", "mean, P", "1", "h nonlinear within P: badly overconfident"),
    "iekf": Words("f nearly linear; one mode", "mean, P", "1", "two modes; full steps may overshoot"),
    "ukf": Words(
        "belief nearly Gaussian", "mean, P", "2", "strong nonlinearity: the gain is that of a wide average"
    ),
    "ckf": Words("belief nearly Gaussian", "mean, P", "1", "as `ukf`"),
    "mhe": Words("one mode", "L steps, mean, P", "100", "two modes"),
    "fading": Words(
        "f and h nearly linear; the model drifts", "mean, P", "1", "a model that is right: it forgets too soon"
    ),
    "h-infinity": Words("bounded noise of any kind", "mean, P", "1", "random noise: larger errors than `ekf`"),
    "schmidt": Words("some states are better not corrected", "mean, P", "1", "as `ekf`"),
    "enkf": Words("belief nearly Gaussian", "N members", "30", "small N: overconfident; sampling noise"),
    "etkf": Words("belief nearly Gaussian", "N members", "30", "small N: overconfident"),
    "letkf": Words(
        "as `etkf`; what is far is not correlated", "N members", "30", "a radius too small or too large"
    ),
    "ensrf": Words("belief nearly Gaussian", "N members", "20", "small N: overconfident"),
    "denkf": Words("good models, poor measurements", "N members", "30", "accurate sensors: P too wide"),
    "ienkf": Words("one mode", "N members", "30", "two modes; large N at strong nonlinearity"),
    "enkf-n": Words("as `etkf`; N is small", "N members", "30", "a wrong model, taken for sampling error"),
    "rhf": Words("states follow what is measured linearly", "N members", "60", "few members; many channels: slow"),
    "pf": Words("none on shape", "N weighted particles", "400", "few particles: one takes all the weight"),
    "apf": Words("none on shape", "N weighted particles", "600", "as `pf`, later"),
    "rbpf": Words(
        "linear where the sampled states are known",
        "N weighted Gaussians",
        "200",
        "few particles; others nonlinear",
    ),
    "gsf": Words(
        "h nonlinear in one component of the state", "mean, P between updates", "20", "nonlinearity in others"
    ),
    "imm": Words("one of K models at a time", "K means and P, probabilities", "3", "a mode that no model has"),
    "mmae": Words("one of K models, always", "K means and P, probabilities", "4", "a plant that switches"),
    "fuzzy": Words("the state stays within a narrow range", "mean, P of 2^n rules", "3", "a wide range"),
    "sage-husa": Words(
        "R (and Q) unknown, steady", "mean, P, R, Q", "3", "where `ekf` fails: takes nonlinearity for noise"
    ),
    "vb": Words("R unknown, steady", "mean, P, distribution of R", "5", "R that changes faster than it forgets"),
    "ekf-robust": Words("heavy-tailed v", "mean, P, last weight", "5", "a noisy sensor looks like many outliers"),
    "open-loop": Words("a perfect model", "a point", "2", "any disturbance or wrong parameter"),
    "low-pass": Words("slow signals", "a point", "60", "transients: it lags"),
    "inversion": Words("h solvable for one component", "a point", "70", "noise, most where h is flat"),
}


class Situation(NamedTuple):
    """A case of the decision list: runs, and filters to compare on them."""

    name: str
    runs: Callable[[], Runs]
    filters: dict[str, Filter]


def kinds() -> str:
    """All filters: assumptions, belief, calls of the model in a step, and when they fail."""
    header = ["name", "class", "assumes", "belief", "P", "likelihood", "f, h a step", "time", "fails"]
    rows = []
    for name, kind in FILTERS.items():
        words = WORDS[name]
        likelihood = "no" if not kind.has_covariance else "N(0, S)" if kind.gaussian_likelihood else "of a mixture"
        row = [f"`{name}`", f"`{kind.__name__}`", words.assumes, words.belief]
        row += ["yes" if kind.has_covariance else "no", likelihood, calls(name)]
        rows.append([*row, words.ratio, words.fails])
    return markdown_table(header, rows)


def calls(name: str) -> str:
    """How often a filter calls the model's f and h, or their Jacobians, in a step without substeps."""
    members, count = 16, Counter()  # whole vector registers, so that no member is padding

    def counted(letter: str, function: Callable) -> Callable:
        def call(*arguments):
            int(arguments[0][0])  # so that it cannot be traced: it is called
            count[letter] += 1
            return function(*arguments)

        return call

    model = thruster_model()
    functions = {"f": ("transition", "transition_jacobian"), "h": ("observe", "observe_jacobian")}
    fields = [(letter, field) for letter, both in functions.items() for field in both]
    counting = {field: counted(letter, getattr(model, field)) for letter, field in fields}
    sized = filter_type(name).has_ensemble
    filter_ = make_filter(
        name, model.replace(**counting, substeps=1), **({"ensemble_size": members} if sized else {})
    )
    with interpreted():
        belief, _ = filter_.update(filter_.init(), [0.1])
        for _ in range(getattr(filter_, "horizon", 0)):  # until its window is full
            belief, _ = filter_.update(filter_.predict(belief, [12.0]), [0.1])
        count.clear()
        filter_.update(filter_.predict(belief, [12.0]), [0.1])
    if not count:
        return "none: matrices"
    each = [count[letter] // (members if sized else 1) for letter in "fh"]
    return ", ".join(("N" if times == 1 else f"{times} N") if sized else str(times) for times in each)


def advice() -> str:
    """The decision list as measured."""
    rows = []
    for situation in situations():
        runs = situation.runs()
        for number, (label, filter_) in enumerate(situation.filters.items()):
            motor, flow, squares = errors_of(filter_, runs)
            honesty = "" if np.isnan(squares) else digits(squares) if squares < 1000 else "> 1000"
            rows.append(["" if number else situation.name, label, digits(motor), digits(flow), honesty])
    return markdown_table(["situation", "filter", "omega_m [rad/s]", "U_a [m/s]", "NEES"], rows)


def situations() -> list[Situation]:
    """The cases of the decision list."""
    plain, published, signless = thruster_model(), thruster_model(**PUBLISHED_NOISE), thruster_model(**SIGNLESS)
    quiet, loud = plain, thruster_model(measurement_noise_cov=LOUD**2)
    flow = augmented_model(plain, {"ambient_velocity": Unknown(std=0.5)})
    wrong = thruster_model(parameter_factors={"voltage_gain": 0.95})
    wrong_twice = thruster_model(parameter_factors={"voltage_gain": 0.95, "lift_coefficient": 1.15})
    gain = {"voltage_gain": Unknown(std=0.1 * plain.constants.voltage_gain)}

    def named(model: StateSpaceModel, *names: str) -> dict[str, Filter]:
        return {f"`{name}`": make_filter(name, model) for name in names}

    return [
        Situation(
            "levels from 11 to 13 V",
            partial(held_runs, amplitude=1.0, centre=12.0, initial_state={"voltage": 12.0}),
            named(thruster_model(initial_state={"voltage": 12.0}), "kf", "kf-steady", "ekf"),
        ),
        Situation(
            "levels within 12 V of 0",
            held_runs,
            named(plain, "kf")
            | {"`kf`, schedule of 9": make_filter("kf", plain, schedule=9)}
            | named(plain, "ekf", "iekf", "ukf", "ckf", "enkf", "etkf", "pf", "gsf", "ekf-robust", "vb")
            | named(plain, "open-loop", "inversion", "low-pass"),
        ),
        Situation(
            "the same at the published noise",
            partial(held_runs, **PUBLISHED_NOISE),
            named(published, "ekf", "iekf", "ukf", "ckf", "enkf", "ienkf", "pf", "gsf", "vb", "sage-husa"),
        ),
        Situation(
            "only the magnitude of the speed is measured, within 0.3 V of 0",
            partial(signless_runs, 40),
            named(signless, "ekf", "ukf", "enkf")
            | {"`gsf`, component 0": make_filter("gsf", signless, component=0)}
            | {f"`pf`, N = {size}": make_filter("pf", signless, ensemble_size=size) for size in (100, 5000)},
        ),
        Situation(
            "one measurement in ten is off by 10 N",
            partial(held_runs, **outliers(0.1)),
            named(quiet, "ekf", "vb", "sage-husa", "ekf-robust", "imm"),
        ),
        Situation(
            "R is 16 times the assumed one",
            partial(held_runs, measurement_noise_cov=LOUD**2),
            named(quiet, "ekf", "ekf-robust", "sage-husa", "vb") | {"`ekf`, right R": make_filter("ekf", loud)},
        ),
        Situation(
            "flow of 0.6 m/s, unknown",
            partial(held_runs, ambient_velocity=0.6),
            named(plain, "ekf")
            | {f"`{name}`, flow a state": make_filter(name, flow) for name in ("ekf", "enkf", "pf")},
        ),
        Situation(
            "voltage gain assumed 5 % low",
            held_runs,
            named(wrong, "ekf") | {"`ekf`, gain a state": make_filter("ekf", augmented_model(wrong, gain))},
        ),
        Situation(
            "and lift assumed 15 % high",
            held_runs,
            named(wrong_twice, "ekf")
            | {"`ekf`, gain a state": make_filter("ekf", augmented_model(wrong_twice, gain))},
        ),
    ]


TABLES = {"kinds": kinds, "advice": advice}
