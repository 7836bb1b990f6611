"""Common to all plants: the state-space model, truth drawn from it, disturbances, and the mechanics of an env."""

from gymnasium.envs.registration import register, registry

from thruster_env.numerics.compiled import may_be_inlined

may_be_inlined(__name__, "thruster_env.numerics")

if "Replay-v0" not in registry:
    register(id="Replay-v0", entry_point="thruster_env.plants.replay:ReplayEnv")
