"""A model with other covariances is a model of its own, whatever class it is of."""

from dataclasses import dataclass

import numpy as np
import pytest

from filters import StateSpaceModel
from thruster_env.model.quantities import Quantity

GIVEN = {
    "transition": lambda x, u, c: (0.9 * x[0] + u[0],),
    "observe": lambda x, c: (x[0],),
    "process_noise_cov": [1.0],
    "measurement_noise_cov": [2.0],
    "prior_mean": [0.0],
    "prior_cov": [1.0],
    "outputs": {"y": (Quantity("y", "y", ""), lambda x, c: x[0])},
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Checked(StateSpaceModel):
    """A user's model with a field, a rule and a number of its own."""

    tag: str = ""

    def __post_init__(self):
        """Check, and keep the ratio of Q to R."""
        super().__post_init__()
        if self.process_noise_cov[0, 0] > 5:
            raise ValueError("Q is too large")
        object.__setattr__(self, "ratio", float(self.process_noise_cov[0, 0] / self.measurement_noise_cov[0, 0]))


class WithMore(StateSpaceModel):
    """A user's model that keeps something beside the fields."""

    def __init__(self, **fields):
        """Keep Q once more."""
        super().__init__(**fields)
        object.__setattr__(self, "kept", float(self.process_noise_cov[0, 0]))


def test_a_subclass_checks_and_derives_what_it_does_for_a_new_model():
    model = Checked(**GIVEN, tag="mine")
    other = model.replace(process_noise_cov=[3.0])
    assert (type(other), other.tag, other.ratio) == (Checked, "mine", 1.5)
    with pytest.raises(ValueError, match="Q is too large"):
        model.replace(process_noise_cov=[9.0])
    assert WithMore(**GIVEN).replace(process_noise_cov=[3.0]).kept == 3.0


def test_models_share_nothing_that_can_be_changed():
    model = StateSpaceModel(**GIVEN)
    numbers = model.numbers.copy()
    other = model.replace(process_noise_cov=[3.0])
    for array in (other.measurement_noise_cov, other.prior_mean, other.prior_cov, other.process_noise_cov):
        array += 7.0
    other.outputs.clear()
    assert np.array_equal(model.numbers, numbers) and list(model.outputs) == ["y"]
