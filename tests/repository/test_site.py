"""What the site is made of, without building it: pages, reference, equations."""

import importlib
import re
from pathlib import Path

import pytest

from docs._ext.equations import inline, latex_of, readable
from docs._ext.generated import ORDER, commands
from filters.registry import FILTERS

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


def test_lines_of_an_equation_stand_below_each_other_beside_their_labels():
    latex = latex_of("predict: x = y\nupdate:  z = x,\n         y = z")
    assert latex == (r"\begin{aligned}\text{predict:} & x = y \\ \text{update:} & z = x, \\ & y = z\end{aligned}")


@pytest.mark.parametrize("name", sorted(set(FILTERS) - {"open-loop"}))
def test_a_filter_shows_its_equations(name):
    lines = readable([line.removeprefix("    ") for line in FILTERS[name].__doc__.split("\n")])
    blocks = [lines[place + 2] for place, line in enumerate(lines) if line == ".. math::"]
    assert blocks and all(block.count("{") == block.count("}") for block in blocks)
    assert "&" in blocks[0] and "|" not in blocks[0]


def test_prose_keeps_its_bars_asterisks_and_underscores():
    assert readable(["|e| of x_ and `*args`"]) == [r"\|e\| of x\_ and `*args`"]
    assert readable(["All `Log`s."]) == [r"All `Log`\ s."]
    assert readable(["One.", "", "    [columns]", "    thrust = 1"])[2] == ".. code-block:: text"


def test_tables_of_an_env_become_tables():
    lines = readable(["## Action space", "| num | max |", "|---|---|", "| 0 | V |"])
    assert [line for line in lines if line] == [
        ".. rubric:: Action space",
        ".. list-table::",
        "    :header-rows: 1",
        "    * - num",
        "      - max",
        "    * - 0",
        "      - V",
    ]


def test_tutorials_are_the_scripts_in_examples():
    assert sorted(path.stem for path in (ROOT / "examples").glob("*.py")) == sorted(ORDER)


def test_examples_of_the_command_line_page_can_be_copied():
    text = commands()
    assert (
        "```console\n$ thruster filters ukf\n$ thruster filters --problem" in text
        and "Example: thruster" not in text
    )
    assert "* `--json FILE`: " in text and "* `--seed INTEGER`: " in text
    assert re.search(
        r"^\* `verify`: Recompute the held-out metrics .*, and say whether they hold\.$", text, re.MULTILINE
    )
    assert not re.search(r"^\* `\w+`: .*\.\.\.$", text, re.MULTILINE)  # no summary is cut
    assert not re.search(r"^\* `[^`]*<", text, re.MULTILINE) and "[default: (" not in text


def test_no_line_to_install_is_cut():
    page = (ROOT / "docs" / "index.md").read_text()
    lines = re.findall(r"^    (pip .*)$", page, flags=re.MULTILINE)
    assert len(lines) == 2 and max(map(len, lines)) <= 36  # letters in a block on a phone of 390 pixels


@pytest.mark.parametrize(
    "words", ["session", "positive", "real time", "restart", "gate", "missing", "overconfident"]
)
def test_a_search_leads_to_a_title_or_a_word_of_the_glossary(words):
    pages = [page.read_text() for page in (ROOT / "docs").rglob("*.md") if "tutorials" not in page.parts]
    titles = [line for page in pages for line in re.findall(r"^#+ (.*)$", page, flags=re.MULTILINE)]
    terms = re.findall(r"^(\w.*)\n(?=\w|  )", (ROOT / "docs" / "glossary.md").read_text(), flags=re.MULTILINE)
    assert any(re.search(rf"\b{words}\b", one, re.IGNORECASE) for one in [*titles, *terms])
