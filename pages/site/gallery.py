"""The tutorials: scripts in examples/, in the order in which one reads them. They run while the site is built."""

ORDER = (
    "first_steps",
    "choose_a_filter",
    "tune",
    "own_model",
    "own_env",
    "own_log",
    "policies",
    "ppo",
    "vehicle",
)
SHOWN_ONLY = ("ppo",)  # learns for a minute; its own test runs it with few steps


def in_order(name: str) -> int:
    """The place of a script, by its file name."""
    return ORDER.index(name.removesuffix(".py"))
