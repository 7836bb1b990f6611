"""Who may know whom, read from the imports of every file."""

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from thruster_env.numerics.compiled import package_of
from tuning.problems.plant_packages import PLANT_PACKAGES

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = (
    "thruster_env",
    "auv_env",
    "filters",
    "tuning",
    "thruster_cli",
)  # a user's folder has none of these names
NUMERICS, PLANTS, TRAINING, STUDIES = (
    f"thruster_env/{name}" for name in ("numerics", "plants", "training", "studies")
)
LAYERS = (NUMERICS, PLANTS, *PACKAGES[:-1], TRAINING, STUDIES, PACKAGES[-1])
FILES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
every_package = pytest.mark.parametrize("package", LAYERS)

ALLOWED = {
    NUMERICS: set(),
    PLANTS: {NUMERICS},
    "thruster_env": {NUMERICS, PLANTS},
    "auv_env": {NUMERICS, PLANTS},
    "filters": {NUMERICS, PLANTS},
    "tuning": {NUMERICS, PLANTS, "filters"},
    TRAINING: {NUMERICS, PLANTS, "thruster_env", "auv_env", "filters", "tuning"},
    STUDIES: {NUMERICS, PLANTS, "thruster_env", "auv_env", "filters", "tuning"},
    "thruster_cli": set(LAYERS),
}
TUNING_OF_PLANTS = {
    "tuning/thruster": {"thruster_env"},
    "tuning/auv": {"auv_env"},
}  # the packages of tuning that know a plant
LEARNING = {"stable_baselines3", "sb3_contrib", "rl_zoo3", "torch"}
OF_PAGES = {"bokeh", "tornado", "jinja2", "markupsafe"}
PAGE = "tuning/exploring/page/"  # what a browser shows of a bench
OF_TENSORS = (  # networks in models and estimators
    "filters/tensors/",
    "filters/learned/",
    "tuning/learning/",
    "thruster_env/numerics/torch_threads.py",
)


@cache
def imports_of(path, source=None):
    """Modules that a file imports, anywhere in it, by full name: `from a import b` gives a and a.b."""
    found = set()  # a caller must not change it: it is remembered
    package = path.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(path.read_text() if source is None else source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            home = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*home, *([node.module] if node.module else [])])
            found |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return found


def packages_of(path):
    return {name.partition(".")[0] for name in imports_of(path)}


def layers_of(path):
    """The packages that a file knows."""
    return {package_of(name).replace(".", "/") for name in imports_of(path)}


def test_imports_are_found_wherever_they_hide():
    source = "import a.b\nfrom c import d\nfrom . import e\nfrom .f import g\ndef h():\n    import i as j\n"
    found = imports_of(ROOT / "filters" / "some.py", source)
    assert found == {"a.b", "c", "c.d", "filters", "filters.e", "filters.f", "filters.f.g", "i"}


def test_there_is_something_to_read():
    assert ROOT / PLANTS / "state_space.py" in FILES and len(FILES) > 20


def those(condition):
    """Names of the files for which a condition holds."""
    return [path.relative_to(ROOT).as_posix() for path in FILES if condition(path)]


def own_package_of(path):
    return package_of(".".join(path.relative_to(ROOT).with_suffix("").parts)).replace(".", "/")


def known_to(path):
    """Our packages that a file may import."""
    package = path.relative_to(ROOT).parent.as_posix()
    return ALLOWED[own_package_of(path)] | {own_package_of(path)} | TUNING_OF_PLANTS.get(package, set())


def test_a_package_knows_only_the_packages_below():
    assert not those(lambda path: layers_of(path) & set(LAYERS) - known_to(path))


def test_packages_of_tuning_know_those_of_plants_by_the_finder_alone():
    packages = {package.replace("/", ".") for package in TUNING_OF_PLANTS}
    outside = [path for path in FILES if path.relative_to(ROOT).parent.as_posix() not in TUNING_OF_PLANTS]
    knowing = [path for path in outside if own_package_of(path) == "tuning" and imports_of(path) & packages]
    assert not knowing and set(PLANT_PACKAGES.values()) == {f"{package}.find" for package in packages}


def test_imports_of_training_go_in_no_circle_not_even_within_functions():
    files = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in FILES}
    code = {name: path.read_text() for name, path in files.items() if name.startswith("thruster_env.training.")}
    for name, text in code.items():  # what only a type checker sees is left out
        code[name] = re.sub(r"^if TYPE_CHECKING:\n(?:    .*\n|\n)+", "", text, flags=re.MULTILINE)
    graph = {name: imports_of(files[name], text) & code.keys() - {name} for name, text in code.items()}
    assert sum(map(len, graph.values())) > 50
    TopologicalSorter(graph).prepare()  # raises CycleError, which names the circle


def test_only_tuning_imports_optuna():
    assert not those(lambda path: "optuna" in packages_of(path) and own_package_of(path) != "tuning")


def test_the_page_alone_imports_bokeh_and_computes_nothing():
    knowing = those(lambda path: packages_of(path) & OF_PAGES)
    assert knowing and all(name.startswith(PAGE) for name in knowing)
    assert not those(lambda path: path.is_relative_to(ROOT / PAGE) and packages_of(path) & {"filters", "optuna"})


def test_only_training_imports_packages_that_learn_policies():
    assert not those(lambda path: packages_of(path) & LEARNING - {"torch"} and own_package_of(path) != TRAINING)


def test_torch_is_imported_by_training_and_where_networks_are_alone():
    knowing = those(lambda path: "torch" in packages_of(path) and own_package_of(path) != TRAINING)
    assert knowing and all(name.startswith(OF_TENSORS) for name in knowing)
    outside = [path for path in FILES if not path.relative_to(ROOT).as_posix().startswith(OF_TENSORS)]
    of_tensors = {name for path in outside for name in imports_of(path) if name.startswith("filters.tensors")}
    assert of_tensors == {"filters.tensors", "filters.tensors.torch"}  # which imports torch when it is called


def test_a_file_is_at_most_600_lines_long():
    assert not those(lambda path: len(path.read_text().splitlines()) > 600)


def opens_bytes(call):
    return len(call.args) > 1 and "b" in getattr(call.args[1], "value", "")


def test_text_files_are_utf_8_whatever_the_terminal_has():
    for path in FILES:
        for call in (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)):
            opens = isinstance(call.func, ast.Name) and call.func.id == "open" and not opens_bytes(call)
            if opens or getattr(call.func, "attr", "") in ("read_text", "write_text"):
                assert "encoding" in {keyword.arg for keyword in call.keywords}, f"{path}:{call.lineno}"


@every_package
def test_a_package_says_that_it_is_typed(package):
    assert (ROOT / package / "__init__.py").is_file()
    assert (ROOT / package / "py.typed").is_file()


def test_the_command_line_starts_without_packages_that_learn_policies():
    code = f"import sys, thruster_cli.app; print([name for name in {sorted(LEARNING)} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_training_of_estimators_imports_torch_when_it_is_called():
    code = "import sys, tuning.api.train_estimator, thruster_cli.train_estimator; print('torch' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"


def test_importing_the_env_stays_light():
    heavy = ["numba", "scipy", "matplotlib", "optuna", "torch", "filters", "tuning"]
    code = f"import sys, thruster_env; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
