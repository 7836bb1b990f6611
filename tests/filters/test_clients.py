"""What other people's programs ask of an env beyond Gymnasium's letter: dtypes in info, the mode of autoreset.

Tried by hand with TorchRL 0.14 (`GymWrapper` with its reader of infos, both envs and vector envs), Minari 0.5
(`DataCollector`), Tianshou 2.0 (its vector envs and replay buffer) and loops as CleanRL writes them.
"""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import thruster_env  # noqa: F401 - registers the envs
from filters import EstimateState
from filters.wrappers.envs import EstimateStates

DROPOUT = {"sensors": {"thrust": [{"name": "dropout", "probability": 0.5}]}}


def make(name, wrapped):
    env = gym.make(name, **({} if "Linear" in name else DROPOUT))
    return EstimateState(env, filter="ekf") if wrapped else env


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", ["BowThrusterTracking-v0", "BowThrusterLinear-v0"])
@pytest.mark.parametrize("wrapped", [False, True])
def test_every_value_of_info_has_a_dtype_and_the_same_at_reset_and_step(name, wrapped):
    env = make(name, wrapped)
    infos = env.reset(seed=0)[1], env.step([3.0])[4]
    kinds = [{key: (np.shape(value), value.dtype) for key, value in info.items()} for info in infos]
    assert kinds[0] == kinds[1] and kinds[0]["thrust"] == ((), np.float64)
    assert all(dtype.kind != "O" for _, dtype in kinds[0].values())
    assert infos[0]["time"] == 0.0 and infos[1]["time"] == 0.01  # of its moment, not views of what goes on
    assert not wrapped or kinds[0]["estimate_divergences"] == ((), np.int64)


@pytest.mark.parametrize("mode", AutoresetMode, ids=lambda mode: mode.value)
def test_a_vector_env_says_how_it_resets_where_gymnasiums_own_do(mode):
    def envs_of(vectorization_mode, **arguments):
        return gym.make_vec("BowThruster-v0", 2, vectorization_mode=vectorization_mode, **arguments)

    native = envs_of("vector_entry_point", autoreset_mode=mode)
    sync = envs_of("sync", vector_kwargs={"autoreset_mode": mode})
    assert isinstance(sync, SyncVectorEnv) and native.autoreset_mode == sync.autoreset_mode == mode
    assert EstimateStates(native, filter="ekf").autoreset_mode == mode
    assert (
        EstimateStates(sync, filter="ekf", model="thruster_env.thruster.model:thruster_model").autoreset_mode
        == mode
    )
