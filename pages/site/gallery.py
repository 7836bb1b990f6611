"""The tutorials: scripts in examples/ that run at build time, in the order in which one reads them."""

ORDER = (
    "first_steps",
    "choose_a_filter",
    "tune",
    "own_model",
    "own_env",
    "own_log",
    "policies",
    "vehicle",
)


def in_order(name: str) -> int:
    """The place of a script, by its file name."""
    return ORDER.index(name.removesuffix(".py"))
