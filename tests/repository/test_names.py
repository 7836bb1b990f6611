"""Names are the field's words: no definition has a word of the list in CONTRIBUTING.md."""

import ast
import re

from tests.repository.test_house import ROOT, nodes_of

PACKAGES = "thruster_env", "filters", "tuning", "docs", "benchmarks", "examples"
PATHS = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]


def words_to_avoid():
    """The first column of the list, each word between underscores."""
    listed = (ROOT / "CONTRIBUTING.md").read_text().partition("| no name has |")[2].partition("\n\n")[0]
    rows = [line.split("|")[1] for line in listed.splitlines()[2:]]
    return [f"_{word.strip()}_" for row in rows for word in row.split(",")]


def defined_in(path):
    """Names that a file defines: its own, functions, parameters, classes, fields."""
    yield path.stem
    for one in nodes_of(path):
        if isinstance(one, ast.FunctionDef | ast.ClassDef):
            yield one.name
        if isinstance(one, ast.arg):
            yield one.arg
        if isinstance(one, ast.ClassDef):
            yield from (line.target.id for line in one.body if isinstance(line, ast.AnnAssign))


def as_words(name):
    return "_" + re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().strip("_") + "_"


def test_no_definition_has_a_word_of_the_list():
    avoided = words_to_avoid()
    assert len(avoided) > 10 and as_words("MyTwin") == "_my_twin_"
    found = {(path.relative_to(ROOT).as_posix(), name) for path in PATHS for name in defined_in(path)}
    found = [one for one in sorted(found) if any(word in as_words(one[1]) for word in avoided)]
    assert not found, found


def variables_to_avoid():
    """The words that no variable is called."""
    sentence = (ROOT / "CONTRIBUTING.md").read_text().partition("No variable is called")[2].partition(":")[0]
    return set(re.findall(r"`(\w+)`", sentence))


def variables_in(path):
    """Variables that a file assigns, but for fields of classes."""
    nodes = nodes_of(path)
    lines = [line for node in nodes if isinstance(node, ast.ClassDef) for line in node.body]
    fields = {id(line.target) for line in lines if isinstance(line, ast.AnnAssign)}
    fields |= {id(target) for line in lines if isinstance(line, ast.Assign) for target in line.targets}
    return {node.id for node in nodes if isinstance(node, ast.Name) and id(node) not in fields}


def test_a_variable_says_what_it_holds():
    avoided = variables_to_avoid()
    assert len(avoided) > 15 and "one" in avoided
    wrong = {path.relative_to(ROOT).as_posix(): variables_in(path) & avoided for path in PATHS}
    assert not {name: words for name, words in wrong.items() if words}
