"""What pictures of a report say: labels beside low panels, and axes as numbers are searched."""

import numpy as np
import optuna
import pytest

from filters import ExtendedKalmanFilter, StateSpaceModel
from tuning.problems.model_problem import ModelProblem
from tuning.reporting.search_figures import draw_slices
from tuning.reporting.time_figures import axis_label, draw_estimates, draw_gains, draw_innovations, draw_signal

LONG = "temperature of the water in the outer cooling jacket"


def linear_model(names=(LONG, LONG)):
    return StateSpaceModel(
        transition=lambda x, u, c: (0.9 * x[0] + u[0], 0.8 * x[1] + 0.1 * u[1]),
        observe=lambda x, c: x,
        process_noise_cov=[0.1, 0.1],
        measurement_noise_cov=[1.0, 1.0],
        prior_mean=[0.0, 0.0],
        prior_cov=[1.0, 1.0],
        inputs=2,
        states=[(names[0], "T_j", "degC"), (names[1], "T_k", "degC")],
        input_quantities=[(f"{names[0]} in", "T_a", "degC"), (f"{names[1]} in", "T_b", "degC")],
        measurements=[(names[0], "z_j", "degC"), (names[1], "z_k", "degC")],
    )


def upright(figure):
    """Extents of all labels that stand upright beside panels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    labels = [axis.yaxis.label for axis in figure.axes]
    return [label.get_window_extent(canvas.get_renderer()) for label in labels if label.get_text()]


@pytest.mark.parametrize("which", ["signal", "innovations", "gains", "run"])
def test_labels_of_long_names_do_not_overlap_and_are_not_cut(which, as_python):
    model = linear_model()
    data = ModelProblem(model, inputs=np.ones((60, 2)), first_scored_step=5, scale=(1.0, 1.0)).data([3])
    filter_ = ExtendedKalmanFilter(model=model)
    figure = {
        "signal": lambda: draw_signal(filter_, data, 0, 0.1),
        "innovations": lambda: draw_innovations({"tuned": filter_}, data, 0, 0.1),
        "gains": lambda: draw_gains({"tuned": filter_}, data, 0, 0.1),
        "run": lambda: draw_estimates({"tuned": filter_}, data, 0, 0.1),
    }[which]()
    found = upright(figure)
    assert len(found) >= 2
    for place, one in enumerate(found):
        assert one.y0 >= 0 and one.y1 <= figure.bbox.height and one.x0 >= 0
        assert not any(one.overlaps(other) for other in found[:place])


def test_a_name_is_broken_between_words_and_its_symbol_is_kept():
    label = axis_label(linear_model().states[0])
    assert label.splitlines()[-1] == "[degC]" and "$" in label and max(map(len, label.splitlines())) <= 18
    assert " ".join(label.splitlines()[:-1]).startswith(LONG)


def test_a_number_searched_on_a_logarithmic_scale_has_a_logarithmic_axis():
    study = optuna.create_study()
    ranges = {
        "Q": optuna.distributions.FloatDistribution(1e-10, 1e4, log=True),
        "c": optuna.distributions.FloatDistribution(0.0, 1.0),
    }
    for k in range(3):
        given = {"Q": 10.0 ** (3 * k - 6), "c": k / 3}
        study.add_trial(optuna.trial.create_trial(params=given, distributions=ranges, value=1.0 + k))
    scales = [axis.get_xscale() for axis in draw_slices(study.trials, "score").axes]
    assert scales == ["log", "linear"]
