"""A linear problem for tests: any number of states and channels, a derived output, with or without truth."""

import numpy as np

from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.model import simulate
from thruster_env.model.affine import affine_model
from thruster_env.model.quantities import Quantity
from tuning.problems.data import Data
from tuning.problems.problem import Problem

STATES = (
    Quantity("position", "p", "m"),
    Quantity("velocity", "v", "m/s"),
    Quantity("bias of the gauge", "b", "m"),
)
CHANNELS = (Quantity("range", "r", "m"), Quantity("speed", "s", "m/s"))


def energy(x, c):
    """Kinetic energy of a unit mass [J]."""
    return 0.5 * x[1] * x[1]


class LinearProblem(Problem):
    """States that turn slowly from one into the next; of the first channels the first states are measured."""

    def __init__(self, n=3, m=2, truth=True, steps=70, first_scored=10, scale=None):
        """A problem of n states and m channels."""
        self.n, self.m, self.truth, self.steps, self.first_scored = n, m, truth, steps, first_scored
        self.name, self.about = f"linear-{n}", ""
        self.scale = (scale or (0.3,) * n) if truth else None

    @property
    def digest(self):
        """Enough for a test."""
        return f"{self.n}-{self.m}-{self.truth}"

    def model(self, process_noise_cov=None, measurement_noise_cov=None, prior_cov_factor=1.0):
        """The plant itself, but for its noise."""
        n, m = self.n, self.m
        states = STATES[:n] + tuple(Quantity(f"slow mode {i}", f"q_{i}", "K") for i in range(4, n + 1))
        found = affine_model(
            a=0.9 * np.eye(n) + 0.1 * np.eye(n, k=1),
            b=np.eye(n)[:, -1:],
            c=np.eye(m, n),
            process_noise_cov=np.full(n, 0.02) if process_noise_cov is None else process_noise_cov,
            measurement_noise_cov=np.full(m, 0.1) if measurement_noise_cov is None else measurement_noise_cov,
            prior_mean=np.zeros(n),
            prior_cov=np.full(n, 0.1 * prior_cov_factor),
            states=states,
            measurements=CHANNELS[:m],
            input_quantities=[Quantity("push", "u", "N")],
        )
        outputs = {"E": (Quantity("energy", "E", "J"), energy)} if n > 1 else {}
        return found.replace(outputs=outputs)

    def data(self, seeds):
        """Truth drawn from the model under a square wave, one measurement in ten missing."""
        keys = episode_keys(seeds)
        inputs = np.tile(np.sign(np.sin(np.arange(self.steps) / 6.0))[:, None] * 0.5, (len(keys), 1, 1))
        with interpreted():
            drawn = simulate.simulate(self.model(), keys, inputs)
        lost = np.random.default_rng(len(keys)).random(drawn.measurements.shape) < 0.1
        seen = np.where(lost, np.nan, drawn.measurements)
        data = Data(tuple(seeds), inputs, seen, filter_keys(seeds), self.first_scored)
        if not self.truth:
            return data
        outputs = {"E": energy(tuple(np.moveaxis(drawn.states, -1, 0)), ())} if self.n > 1 else {}
        return data._replace(states=drawn.states, outputs=outputs)

    @property
    def untuned(self):
        """Ten times the plant's Q."""
        return {"process_noise_cov": (0.2,) * self.n, "measurement_noise_cov": self._r}

    @property
    def true(self):
        """The plant's own noise."""
        return {"process_noise_cov": (0.02,) * self.n, "measurement_noise_cov": self._r}

    @property
    def _r(self):
        return (0.1,) * self.m if self.m > 1 else 0.1
