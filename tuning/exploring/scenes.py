"""Six guided scenes: what Q, R, an ensemble's size and a model's constants do, each to be seen by hand.

A scene is data: where one starts, what one changes, and what one then sees, which the tests hold.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from tuning.exploring.bench import Bench
from tuning.exploring.view import View
from tuning.problems.find import find_problem


class Step(NamedTuple):
    """One setting of a scene."""

    label: str
    filter: str
    values: Mapping[str, float]  # by knob; the others are those of the start


class Seen(NamedTuple):
    """A figure of the last step over that of the first: what the scene is about."""

    figure: str
    low: float
    high: float


class Scene(NamedTuple):
    """A lesson with its set-up."""

    name: str
    title: str
    text: str  # what it teaches
    todo: str  # what one does
    problem: str
    steps: tuple[Step, ...]  # the first is where one starts
    knobs: tuple[str, ...]  # that one moves
    state: str  # symbol of the state to look at
    seen: tuple[Seen, ...]

    def bench(self, step: int = 0) -> Bench:
        """The bench of a step."""
        return Bench(find_problem(self.problem), self.steps[step].filter)

    def view(self, step: int = 0, seeds: int = 8) -> View:
        """What one sees at a step."""
        return self.bench(step).view(self.steps[step].values, seeds)


OWN = {"Q11": 1.0, "Q22": 4e-4, "R": 0.25}  # the plant's own Q and R, in (rad/s)^2, (m/s)^2 and N^2

SCENES = {
    scene.name: scene
    for scene in (
        Scene(
            "ridge",
            "Only the ratio of Q to R moves the estimate",
            "A Kalman filter weighs its model against the sensor, and only the ratio of Q to R enters the "
            "weights. Multiply both by thirty and every estimate stays where it was; but the filter now claims "
            "errors more than five times as large as they are. On a map of the error that is a ridge, or rather "
            "a valley: all along it the RMSE is the same. What tells one end from the other are the "
            "innovations: their squares over the variance that the filter expects, the NIS, should be about 1.",
            "Raise both Q and R by the same factor. The lines stay, the bands widen, the NIS falls.",
            "nominal",
            (
                Step("the plant's own Q and R", "ekf", OWN),
                Step("both thirty times as large", "ekf", {"Q11": 30.0, "Q22": 0.012, "R": 7.5}),
            ),
            ("Q11", "Q22", "R"),
            "U_a",
            (Seen("RMSE U_a", 0.98, 1.02), Seen("NIS", 0.03, 0.037), Seen("NEES", 0.03, 0.037)),
        ),
        Scene(
            "lag",
            "With too small a Q the estimate lags",
            "Q says how far the state may stray from the model in one step. Here the water flows past the "
            "thruster, slowly changing, and the model knows nothing of it. With a small Q the filter trusts its "
            "model, takes what the sensor says for noise, and follows the flow long after it has changed. The "
            "innovations give it away: they stay on one side for many steps, and one tells the next.",
            "Raise Q of the flow velocity until the estimate follows, and the autocorrelation falls into its "
            "band.",
            "ambient",
            (
                Step("a small Q of the flow", "ekf", {**OWN, "Q22": 4e-6}),
                Step("a Q that lets it follow", "ekf", {**OWN, "Q22": 4e-3}),
            ),
            ("Q22",),
            "U_a",
            (Seen("RMSE U_a", 0.3, 0.6), Seen("NIS", 0.05, 0.4)),
        ),
        Scene(
            "outliers",
            "One outlier in twenty is enough",
            "The sensor's data sheet says 0.5 N, and most of the time that is true; but one measurement in "
            "twenty is off by some 10 N. Squares make few large errors count more than many small ones, and a "
            "Kalman filter knows nothing but squares: with the R of the data sheet each outlier throws the "
            "estimate off. A larger R buys peace at a price, for the good measurements count less, too. A "
            "filter that looks at the size of an innovation before it believes it, ekf-robust, does better than "
            "any R.",
            "Raise R until the jumps are gone: a hundred times the data sheet's leaves less than a quarter of "
            "the error.",
            "outliers",
            (
                Step("R from the data sheet", "ekf", {}),
                Step("a hundred times that R", "ekf", {"R": 25.0}),
            ),
            ("R",),
            "omega_m",
            (Seen("RMSE omega_m", 0.05, 0.25), Seen("RMSE U_a", 0.2, 0.4)),
        ),
        Scene(
            "tangent",
            "An EKF believes in its tangent",
            "This tachometer has no sign: it reads the magnitude of the speed. An extended Kalman filter "
            "replaces it by its tangent at the estimate, and a tangent at either side of zero knows nothing of "
            "the other side. Where the speed crosses zero the filter takes the wrong branch and is sure of it. "
            "The NIS stays close to 1, so the innovations do not tell; the NEES, errors against the truth, "
            "does. The unscented filter tries several points on both sides and knows that it does not know.",
            "Change the filter from ekf to ukf: the same Q and R, and the errors fit the band again.",
            "speed_magnitude",
            (
                Step("ekf: one tangent", "ekf", OWN),
                Step("ukf: points on both sides", "ukf", OWN),
            ),
            (),
            "omega_m",
            (Seen("NEES", 0.2, 0.5), Seen("RMSE omega_m", 0.6, 0.9), Seen("NIS", 0.7, 1.1)),
        ),
        Scene(
            "ensemble",
            "Five members are too few",
            "An ensemble filter measures its covariance from its members. Five of them see a covariance that is "
            "right on average and wrong each time; the gain follows its errors, the mean takes over part of the "
            "noise, and the spread comes out too small for the error that is left. The filter is overconfident, "
            "at the right Q and R. Inflation hides it; more members cure it.",
            "Raise the number of members from 5 to 100 and see NEES fall to the number of states, 2.",
            "nominal",
            (
                Step("5 members", "enkf", {**OWN, "N": 5}),
                Step("100 members", "enkf", {**OWN, "N": 100}),
            ),
            ("N", "inflation"),
            "U_a",
            (Seen("NEES", 0.1, 0.3), Seen("RMSE U_a", 0.7, 0.95)),
        ),
        Scene(
            "constant",
            "No Q makes up for a wrong constant",
            "The filter's model has 15 % more lift and 5 % less voltage gain than the plant. The thrust that it "
            "expects is that of another speed, so that it takes the motor for too slow, ahead and astern alike. "
            "Noise changes its sign; the error of a wrong constant does not. A larger Q widens the band and "
            "leaves the error where it is: the NIS can be brought to 1, the error cannot be brought down. What "
            "helps is the right constant, estimated with the states or identified from recorded runs.",
            "Raise Q as far as you like: the band grows, and the RMSE of the motor speed stays.",
            "mismatch",
            (
                Step("the plant's own Q", "ekf", OWN),
                Step("a hundred times that Q", "ekf", {**OWN, "Q11": 100.0, "Q22": 0.04}),
            ),
            ("Q11", "Q22"),
            "omega_m",
            (Seen("RMSE omega_m", 0.95, 1.15), Seen("NIS", 0.05, 0.2)),
        ),
    )
}
