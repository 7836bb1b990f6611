"""Scenarios of the small plant, as another package brings them by the entry point `tuning.plants`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from tests.small_plant import Q, cart_model, make_cart
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.model.simulate import simulate
from tuning.problems.data import Data
from tuning.problems.excitation import Steps
from tuning.problems.model_problem import average_bound
from tuning.problems.scenario import PlantScenario


def model_of_cart(cart, parameter_factors: Mapping = {}, measurement_noise_cov=None, **changes):  # noqa: B006
    model = cart_model(cart._replace(mass=cart.mass * parameter_factors.get("mass", 1.0)), **changes)
    return model if measurement_noise_cov is None else model.replace(measurement_noise_cov=measurement_noise_cov)


@dataclass(frozen=True, kw_only=True)
class Scenario(PlantScenario):
    plant_kind = "cart"
    of_plant = SimpleNamespace(make_plant=make_cart, plant_data=lambda cart: {"mass": cart.mass})
    model_of_plant = staticmethod(model_of_cart)
    env_id = "tests.small_plant:Cart-v0"
    not_of_env = "process_noise_cov", "measurement_noise_cov"
    process_noise_cov: Sequence[float] = tuple(np.diag(Q).tolist())
    measurement_noise_cov: Sequence[float] = (0.01, 0.04)
    mass: float = 2.0
    dt: float = 0.1

    __hash__ = PlantScenario.__hash__
    state_ranges = property(lambda self: np.array([2.0, 2.0, 4.0]))

    def own_checks(self):
        return {"scale": self.checked_scale(3)}

    def bound(self, data):
        return average_bound(model_of_cart(self.plant), data)

    def make(self, seeds):
        keys = episode_keys(seeds)
        inputs = self.excitation.inputs(keys, self.steps, self.dt, 2)
        truth = simulate(model_of_cart(self.plant), keys, inputs)
        return Data(
            seeds, inputs, truth.measurements, filter_keys(seeds), self.first_scored_step, truth.states, {}
        )


SCENARIOS = {
    "cart": Scenario(name="cart", scale=(0.05, 0.04, 0.03), excitation=Steps(amplitude=2.0, hold=20), steps=80)
}
NOMINAL = "cart"
