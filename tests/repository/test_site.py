"""What the site is made of, without building it: pages, reference, equations."""

import importlib
import re
from pathlib import Path

import pytest

from docs._ext.equations import inline

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [path for path in DOCS.rglob("*.md") if not {"tutorials", "paper"} & {*path.parts}]
REFERENCE = "\n".join(path.read_text() for path in sorted((DOCS / "reference").glob("*.md")))
EQUATIONS = {
    "x_{k+1} = f(x_k, u_k) + w,  w ~ N(0, Q)": (r"x_{k+1} = f(x_{k}, u_{k}) + w,\quad w \sim  \mathcal{N}(0, Q)"),
    "K = P H' S^-1": r"K = P H' S^{-1}",
    "mean += K innovation": r"\text{mean} {+}{=} K\ \text{innovation}",
    "G_k smoothed P_{k+1}": r"G_{k}\ \text{smoothed}\ P_{k+1}",
    "sqrt(n + kappa) sum_j w_j": r"\sqrt{n + \kappa }\ \sum _{j} w_{j}",
    "sum of w_j": r"\text{sum of}\ w_{j}",
    "the filter's members' mean": r"\text{the filter’s members}\text{’ mean}",
    "(n + 2)^(-1/(n + 4)) P_new 5 %": r"(n + 2)^{-1/(n + 4)} P_{\text{new}} 5 \%",
}


def test_every_page_is_in_one_table_of_contents():
    listed = ["index"]
    for page in PAGES:
        for block in re.findall(r"```{toctree}\n(.*?)```", page.read_text(), flags=re.DOTALL):
            entries = [line for line in block.splitlines() if line and not line.startswith(":")]
            names = [re.sub(r".*<(.*)>", r"\1", entry) for entry in entries]
            listed += [(page.parent.relative_to(DOCS) / name).as_posix() for name in names]
    listed.remove("tutorials/index")
    assert sorted(page.relative_to(DOCS).with_suffix("").as_posix() for page in PAGES) == sorted(listed)


@pytest.mark.parametrize("package", ["filters", "thruster_env", "thruster_env.auv", "tuning"])
def test_the_reference_has_every_public_name(package):
    shown = set(re.findall(r"^\.\. auto(?:class|function|data):: (\S+)", REFERENCE, flags=re.MULTILINE))
    names = [name for name in getattr(importlib.import_module(package), "__all__", ()) if not name.startswith("_")]
    assert {f"{package}.{name}" for name in names} <= shown


def test_what_the_reference_names_is_there():
    for name in re.findall(r"^\.\. auto(?:class|function|data):: (\S+)", REFERENCE, flags=re.MULTILINE):
        module, _, attribute = name.rpartition(".")
        assert getattr(importlib.import_module(module), attribute).__doc__, name


@pytest.mark.parametrize(("text", "latex"), EQUATIONS.items(), ids=range(len(EQUATIONS)))
def test_an_equation_is_set(text, latex):
    assert inline(text) == latex
