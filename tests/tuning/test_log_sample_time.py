"""A model of another sample time than its log is refused, where it tells its own."""

from typing import NamedTuple

import numpy as np
import pytest

import filters
import tuning
from thruster_env.env.model_env import ReplayEnv

DT = 0.05
LOG = {"t": DT * np.arange(400), "z": np.cumsum(np.random.default_rng(0).normal(size=400))}


class Constants(NamedTuple):
    dt: float


def move(x, u, c):
    return x[0] + c.dt * x[1], x[1]


def look(x, c):
    return (x[0],)


def model(dt=0.02):
    return filters.StateSpaceModel(
        transition=move,
        observe=look,
        constants=Constants(dt),
        process_noise_cov=[1e-3, 1.0],
        measurement_noise_cov=[0.1],
        prior_mean=[0.0, 0.0],
        prior_cov=[1.0, 1.0],
        measurements=["z"],
    )


def of_one_dt():
    return model()


def matrices(dt):
    return filters.affine_model(F=[[1.0]], H=[[1.0]], Q=[1.0], R=[0.1], P0=[1.0], measurements=["z"], dt=dt)


REFUSED = r"sample time of the model must be that of log .*, 0.05 s, but is 0.02 s: give a function of dt"


@pytest.mark.parametrize("source", [of_one_dt, model(), matrices(0.02)])
def test_a_model_of_another_sample_time_than_its_log_is_refused(source):
    with pytest.raises(ValueError, match=REFUSED):
        tuning.estimate(tuning.read_logs(LOG, model=source), filter="ekf")
    with pytest.raises(ValueError, match=REFUSED):
        tuning.identify(tuning.read_logs(LOG, model=source), free="R")
    with pytest.raises(ValueError, match=REFUSED):
        ReplayEnv(LOG, source)


@pytest.mark.parametrize("source", [model, model(DT * 1.001), matrices(DT), matrices(None)])
def test_a_model_of_the_sample_time_of_its_log_or_of_none_is_taken(source):
    assert ReplayEnv(LOG, source).log.dt == pytest.approx(DT)
