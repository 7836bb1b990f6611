"""Who may know whom, read from the imports of every file."""

import ast
import re
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

from tuning.problems.find import PLANT_PACKAGES

ROOT = Path(__file__).resolve().parents[2]
FLOORS = "thruster_env", "filters", "tuning"  # a floor knows those before it
FILES = [path for floor in FLOORS for path in sorted((ROOT / floor).rglob("*.py"))]

ROOMS = {  # of thruster_env, and the rooms that each knows
    "core": set(),
    "graphs": {"core"},
    "model": {"core", "graphs"},
    "effects": {"core", "graphs"},
    "render": {"core"},
    "logs": {"core", "model"},
    "env": {"core", "graphs", "model", "effects", "render", "logs"},
    "thruster": {"core", "graphs", "model", "effects", "render", "logs", "env"},
    "auv": {"core", "graphs", "model", "effects", "render", "logs", "env"},
}
PLANTS = {"thruster", "auv"}
KNOW_PLANTS = ("tuning/plants/", "tuning/policies/", "tuning/experiments/", "tuning/cli/")
LEARNING = {"stable_baselines3", "sb3_contrib", "rl_zoo3", "torch"}
OF_PAGES = {"bokeh", "tornado", "jinja2", "markupsafe"}
PAGE = "tuning/exploring/page/"  # what a browser shows of a bench
# Networks in models and estimators.
OF_TENSORS = "filters/tensors/", "filters/learned/", "tuning/learning.py", "thruster_env/core/parallel.py"


@cache
def nodes_of(path):
    """The nodes of a file's syntax tree that tests read: a walk takes longer than all that they ask."""
    kinds = ast.Import | ast.ImportFrom | ast.FunctionDef | ast.ClassDef | ast.arg | ast.Call | ast.Attribute
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    return [
        node
        for node in nodes
        if isinstance(node, kinds) or (isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
    ]


@cache
def imports_of(path, typed=True):
    """Modules that a file imports, anywhere in it, by full name: `from a import b` gives a and a.b.

    Those that only a type checker sees can be left out.
    """
    modules = set()  # a caller must not change it: it is remembered
    package = path.relative_to(ROOT).parent.parts
    checked = range(0) if typed else lines_of_types(path.read_text(encoding="utf-8"))
    for node in nodes_of(path):
        if not isinstance(node, ast.Import | ast.ImportFrom) or node.lineno in checked:
            continue
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        else:
            home = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*home, *([node.module] if node.module else [])])
            modules |= {module} | {f"{module}.{alias.name}" for alias in node.names}
    return modules


def lines_of_types(text):
    """The lines of `if TYPE_CHECKING:`."""
    block = re.search(r"^if TYPE_CHECKING:\n(?:    .*\n|\n)+", text, flags=re.MULTILINE)
    return range(0) if block is None else range(*(text.count("\n", 0, end) + 1 for end in block.span()))


def packages_of(path):
    return {name.partition(".")[0] for name in imports_of(path)}


def name_of(path):
    """The path from the checkout's folder, with slashes."""
    return path.relative_to(ROOT).as_posix()


def rooms_of(path):
    """The rooms of thruster_env that a file knows."""
    parts = (name.split(".") for name in imports_of(path))
    return {part[1] for part in parts if part[0] == "thruster_env" and len(part) > 1} & ROOMS.keys()


def those(condition):
    """Names of the files for which a condition holds."""
    return [name_of(path) for path in FILES if condition(path)]


def floor_of(path):
    return FLOORS.index(path.relative_to(ROOT).parts[0])


def test_floors_know_those_below_alone():
    assert not those(lambda path: packages_of(path) & set(FLOORS[floor_of(path) + 1 :]))


def test_rooms_of_the_ground_floor_go_in_no_circle():
    TopologicalSorter(ROOMS).prepare()  # raises CycleError, which names the circle
    for path in FILES:
        floor, room = path.relative_to(ROOT).parts[:2]
        if floor == "thruster_env" and room != "__init__.py":
            assert rooms_of(path) <= ROOMS[room] | {room}, name_of(path)


def test_filters_know_no_plant_and_tuning_knows_them_by_the_finder_alone():
    knowing = those(lambda path: floor_of(path) > 0 and rooms_of(path) & PLANTS)
    assert knowing and all(name.startswith(KNOW_PLANTS) for name in knowing)
    of_plants = {f"tuning.plants.{name}" for name in ("thruster", "thruster_logs", "auv")}
    assert not those(lambda path: not name_of(path).startswith(KNOW_PLANTS) and imports_of(path) & of_plants)
    assert set(PLANT_PACKAGES.values()) < of_plants


def test_imports_go_in_no_circle_of_more_than_two_files_not_even_within_functions():
    files = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in FILES}
    files = {name.removesuffix(".__init__"): path for name, path in files.items()}
    graph = {}
    for name, path in files.items():  # what only a type checker sees is left out, packages as well
        known = imports_of(path, typed=False) & files.keys()
        graph[name] = {other for other in known if files[other].name != "__init__.py"} - {name}
    assert sum(map(len, graph.values())) > 1500
    pairs = {frozenset((a, b)) for a in graph for b in graph[a] if a in graph[b]}
    of_pair = {name: min(pair) for pair in pairs for name in pair}
    assert len(of_pair) == 2 * len(pairs)  # else three files hang together
    of_all = {of_pair.get(name, name) for name in graph}
    contracted = {name: set() for name in of_all}
    for name, known in graph.items():
        contracted[of_pair.get(name, name)] |= {of_pair.get(other, other) for other in known}
    TopologicalSorter({name: known - {name} for name, known in contracted.items()}).prepare()  # raises CycleError


def test_the_index_in_a_package_s_docstring_names_its_files():
    listed = 0
    for path in FILES:
        if path.name == "__init__.py":
            text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            lines = [re.match(r"([a-z_]+(?:, [a-z_]+)*)  +[a-zA-Z`]", line) for line in text.splitlines()]
            names = [name for line in lines if line for name in line[1].split(", ")]
            missing = [
                name for name in names if not ({name, f"{name}.py"} & {p.name for p in path.parent.iterdir()})
            ]
            assert not missing, (name_of(path), missing)
            listed += len(names)
    assert listed > 20


def test_only_tuning_imports_optuna():
    assert not those(lambda path: "optuna" in packages_of(path) and floor_of(path) != 2)


def test_the_page_alone_imports_bokeh_and_computes_nothing():
    knowing = those(lambda path: packages_of(path) & OF_PAGES)
    assert knowing and all(name.startswith(PAGE) for name in knowing)
    assert not those(lambda path: path.is_relative_to(ROOT / PAGE) and packages_of(path) & {"filters", "optuna"})


def test_only_training_imports_packages_that_learn_policies():
    assert not those(
        lambda path: packages_of(path) & LEARNING - {"torch"} and not name_of(path).startswith("tuning/policies/")
    )


def test_torch_is_imported_by_training_and_where_networks_are_alone():
    knowing = those(lambda path: "torch" in packages_of(path) and not name_of(path).startswith("tuning/policies/"))
    assert knowing and all(name.startswith(OF_TENSORS) for name in knowing)
    outside = [path for path in FILES if not name_of(path).startswith(OF_TENSORS)]
    of_tensors = {name for path in outside for name in imports_of(path) if name.startswith("filters.tensors")}
    assert of_tensors == {"filters.tensors", "filters.tensors.torch"}  # which imports torch when it is called


def test_a_file_is_at_most_600_lines_long():
    assert not those(lambda path: len(path.read_text().splitlines()) > 600)


def opens_bytes(call):
    return len(call.args) > 1 and "b" in getattr(call.args[1], "value", "")


def test_text_files_are_utf_8_whatever_the_terminal_has():
    for path in FILES:
        for call in (node for node in nodes_of(path) if isinstance(node, ast.Call)):
            opens = isinstance(call.func, ast.Name) and call.func.id == "open" and not opens_bytes(call)
            if opens or getattr(call.func, "attr", "") in ("read_text", "write_text"):
                assert "encoding" in {keyword.arg for keyword in call.keywords}, f"{path}:{call.lineno}"


@pytest.mark.parametrize("floor", FLOORS)
def test_a_package_says_that_it_is_typed(floor):
    assert (ROOT / floor / "__init__.py").is_file() and (ROOT / floor / "py.typed").is_file()


ASKED = "filters, importlib.util; importlib.util.find_spec('gymnasium'); import gymnasium"  # whether it is there
ORDERS = (
    "filters, gymnasium",
    "gymnasium, filters",
    "filters, thruster_env.auv",
    "thruster_env.auv, filters",
    ASKED,
)


@pytest.mark.parametrize("order", [*ORDERS, ASKED])
def test_envs_are_registered_in_whichever_order_packages_are_imported(order):
    ids = "BowThruster-v0", "SegorogeniAUVPath-v0", "Replay-v0", "BowThruster-EKF-v0", "SegorogeniAUV-Filtered-v0"
    code = (
        f"import {order}; from gymnasium import registry; print([name for name in {ids} if name not in registry])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


HEAVY = {
    *"bokeh gymnasium h5py jinja2 llvmlite matplotlib numba numpy optuna pandas pint pyarrow pydantic".split(),
    *("pygame", "rich", "sqlalchemy", "stable_baselines3", "torch", "filters", "tuning"),
    *(f"scipy.{part}" for part in ("integrate", "linalg", "optimize", "signal", "special", "stats")),
}
TERMINAL = {"rich", "tuning"}
COMMAND = {*TERMINAL, "pydantic"}  # Typer's
FITTING = {"numpy", "filters", "llvmlite", "scipy.linalg", "scipy.optimize", "scipy.special"}
TUNING = HEAVY - {"matplotlib", "numba", "pandas", "sqlalchemy", "stable_baselines3", "torch"}
MAY_LOAD = {  # what imports, and commands of the command line, may load
    "import thruster_env": set(),
    "import filters": {"filters"},
    "from filters import ExtendedKalmanFilter": {"numpy", "filters"},
    "import tuning": {"tuning"},
    "import gymnasium, thruster_env; gymnasium.make('BowThruster-v0')": {"gymnasium", "numpy", "llvmlite"},
    "thruster --help": TERMINAL,
    "thruster new problem mine": COMMAND,
    "thruster inspect": {*COMMAND, "numpy", "scipy.linalg"},
    "thruster fit acc.csv": COMMAND | FITTING,
    "thruster tune --help": TUNING,
    "thruster train --help": TUNING,
}


def test_every_name_of_filters_has_one_home():
    import filters

    names = [name for names in filters.MODULES.values() for name in names]
    assert len(names) == len(set(names))
    assert set(names) == {*filters.__all__, "thruster_model"}
    assert {*filters.__all__} <= {*dir(filters)}
    source = ast.parse(Path(filters.__file__).read_text())
    block = next(node for node in source.body if isinstance(node, ast.If))
    typed = {
        alias.name: part.module
        for part in ast.walk(block)
        if isinstance(part, ast.ImportFrom)
        for alias in part.names
    }
    assert typed == {name: filters.HOMES[name] for name in filters.__all__}
    assert all(getattr(filters, name) is not None for name in filters.__all__)


@pytest.mark.parametrize("started", MAY_LOAD)
def test_what_users_start_loads_no_heavy_package_that_it_does_not_need(started, tmp_path):
    (tmp_path / "acc.csv").write_text("\n".join(f"{(7 * k) % 11}" for k in range(40)))
    program = started
    if started.startswith("thruster "):
        call = "from tuning.cli.main import main\ntry: main()\nexcept SystemExit: pass"
        program = f"import sys; sys.argv = {started.split()}\n{call}"
    program += f"\nimport sys; sys.stderr.write(repr([name for name in {sorted(HEAVY)} if name in sys.modules]))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=tmp_path)
    assert set(ast.literal_eval(done.stderr.splitlines()[-1])) <= MAY_LOAD[started]
