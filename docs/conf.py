"""Settings of the site, which `make docs` builds into build/docs from these pages and the scripts in examples/."""

import logging
import os
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
os.environ.setdefault("MPLBACKEND", "agg")

from docs._ext.generated import SHOWN_ONLY  # noqa: E402
from thruster_env import __version__ as release  # noqa: E402

project = "thruster-env"
author = "The thruster-env authors"
copyright = author  # noqa: A001 - the name that Sphinx asks for
version = release

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_design",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
    "docs._ext.equations",
    "docs._ext.generated",
]
exclude_patterns = ["_static", "paper", "tutorials/*.ipynb", "tutorials/*.py", "tutorials/*.zip"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "fieldlist"]
myst_heading_anchors = 4
# Equations and terminal output stand in blocks without a language.
highlight_language = "none"
smartquotes = False  # an option such as --out has two hyphens
default_role = "py:obj"
nitpicky = False
html_theme = "furo"
html_title = "thruster-env"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
html_math_renderer = "mathml"
templates_path = ["_templates"]
copybutton_exclude = ".linenos, .gp, .go"
linkcheck_timeout = 20
linkcheck_ignore = [r"https?://localhost.*"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
napoleon_numpy_docstring = False
napoleon_use_ivar = True

sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "tutorials",
    "filename_pattern": rf"/(?!{'|'.join(SHOWN_ONLY)})\w+\.py$",
    "within_subsection_order": "docs._ext.generated.in_order",
    "image_scrapers": ("matplotlib", "docs._ext.generated.result_figures"),
    "default_thumb_file": str(ROOT / "docs" / "plant_frame.png"),
    "capture_repr": ("_repr_html_", "__repr__"),
    "download_all_examples": False,
    "show_signature": False,
    "write_computation_times": False,
    "min_reported_time": 10**6,
    "remove_config_comments": True,
}
logging.getLogger("matplotlib").setLevel(logging.WARNING)
