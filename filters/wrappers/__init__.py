"""Filters around Gymnasium envs and vector envs, and registered envs with a filter around them.

`gym.make("filters:BowThruster-EnKF-v0")` makes one, `gym.make_vec` many.

The entry point group PLANTS lists packages whose envs offer a model. Each of their ids gets a filtered one,
"BowThruster-Filtered-v0", whose argument `filter` names the filter, and one for each of ALIASES, with a vector env
if the id has one.
"""

import warnings
from importlib import import_module

from thruster_env.core.modules import when_imported

PLANTS = "filters.plants"  # group of entry points: packages that register their envs when imported
ALIASES = {"kf": "KF", "ekf": "EKF", "ukf": "UKF", "enkf": "EnKF", "pf": "PF"}


def filtered_id(env_id: str, word: str = "Filtered") -> str:
    """The id of an env with a filter: "BowThruster-v0" and "EnKF" give "BowThruster-EnKF-v0"."""
    name, version = env_id.rsplit("-", 1)
    return f"{name}-{word}-{version}"


def plant_ids() -> list[str]:
    """Ids of the registered envs of the packages in PLANTS; no env is imported.

    A package that cannot be imported has no ids: this runs within `import gymnasium`, which must not fail for it.
    """
    from importlib.metadata import entry_points  # here, because it loads what reads mails

    from gymnasium.envs.registration import registry

    packages = {point.value for point in entry_points(group=PLANTS)}
    for package in sorted(packages):
        try:
            import_module(package)
        except Exception as error:  # whatever its lines raise
            rule = "a package of the entry points filters.plants must import"
            warnings.warn(f"{rule}, but {package} raised {error!r}: its envs are not registered", stacklevel=2)
    entries = [(env_id, spec.entry_point) for env_id, spec in registry.items()]
    return [
        env_id
        for env_id, entry in entries
        if isinstance(entry, str) and entry.partition(":")[0].partition(".")[0] in packages
    ]


def register_filtered_envs() -> None:
    """Register every id of a plant with a filter around its env; a second call has no effect."""
    from gymnasium.envs.registration import register, registry

    for env_id in plant_ids():
        has_vector_env = registry[env_id].vector_entry_point is not None
        for word, filter in [("Filtered", None), *((word, name) for name, word in ALIASES.items())]:
            if filtered_id(env_id, word) not in registry:
                register(
                    id=filtered_id(env_id, word),
                    entry_point="filters.wrappers.envs:make_env",
                    vector_entry_point="filters.wrappers.envs:make_vector_env" if has_vector_env else None,
                    max_episode_steps=registry[env_id].max_episode_steps,
                    kwargs={"env_id": env_id} | ({} if filter is None else {"filter": filter}),
                )


when_imported("gymnasium", register_filtered_envs)
