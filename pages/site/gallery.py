"""The tutorials: scripts in examples/, in the order in which one reads them. They run while the site is built."""

from weakref import WeakSet

ORDER = (
    "first_steps",
    "choose_a_filter",
    "tune",
    "own_model",
    "own_env",
    "own_log",
    "own_filter",
    "policies",
    "ppo",
    "vehicle",
    "networks",
)
SHOWN_ONLY = ("ppo",)  # learns for a minute; its own test runs it with few steps
_shown: WeakSet = WeakSet()


def in_order(name: str) -> int:
    """The place of a script, by its file name."""
    return ORDER.index(name.removesuffix(".py"))


def result_figures(block, block_vars: dict, gallery_conf: dict) -> str:
    """Save the `figure` of a block, as sphinx-gallery asks: what results plot is no figure of pyplot's."""
    from matplotlib.figure import Figure
    from sphinx_gallery.scrapers import figure_rst

    figure = block_vars["example_globals"].get("figure")
    if not isinstance(figure, Figure) or figure in _shown or figure.canvas.manager is not None:
        return ""  # those with a manager are pyplot's, which sphinx-gallery finds by itself
    _shown.add(figure)
    path = next(block_vars["image_path_iterator"])
    figure.savefig(path, bbox_inches="tight")
    return figure_rst([path], gallery_conf["src_dir"])
