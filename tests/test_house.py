"""The rules of the code: imports run one way, files stay readable, CI and README agree."""

import ast
import subprocess
import sys
import warnings
from collections import Counter
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = [
    "errors",
    "entry_points",
    "inputs",
    "process",
    "printable",
    "records",
    "geometry",
    "fringe",
    "examination",
    "target",
    "calibration",
    "reconstruction",
    "registration",
    "surface",
    "evaluation",
    "inspection",
    "simulation",
    "devices",
    "session",
    "report",
    "pipeline",
    "preflight",
    "wizard",
    "server",
    "gui",
    "plugins",
    "operations",
    "validation",
    "terminal",
    "commands",
    "cli",
]
FORBIDDEN = [
    # the renderer's lenses must not hide an error of the calibration's, nor the other way round
    ("simulation", "slviewer.calibration"),
    ("simulation", "slviewer.geometry.lens"),
    ("simulation", "slviewer.geometry.brown"),
    ("simulation", "slviewer.geometry.rig"),
    ("simulation", "slviewer.geometry.triangulation"),
    # replay takes frames, and the pipeline opens the session
    ("session", "slviewer.devices"),
]
NUMERIC = PACKAGES[1 : PACKAGES.index("simulation")]
# a build writes that
SOURCES = sorted(set((ROOT / "slviewer").rglob("*.py")) - {ROOT / "slviewer/_version.py"})
MANY_LINES = 800
MANY_BRANCHES, MANY_PARAMETERS = 15, 8
MOST_WITH_MANY_BRANCHES, MOST_WITH_MANY_PARAMETERS = 0, 0
"""Functions that are allowed more; lower these where some are simplified."""
DECISIONS = (
    ast.If,
    ast.For,
    ast.While,
    ast.IfExp,
    ast.ExceptHandler,
    ast.comprehension,
    ast.Assert,
    ast.match_case,
)
MOST_SHARE = 0.15
"""Of the code in one package; a larger one holds more than one idea."""


@cache
def imports_of(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def package_of(module: str) -> str | None:
    parts = module.split(".")
    return parts[1] if parts[0] == "slviewer" and len(parts) > 1 and parts[1] in PACKAGES else None


def layer_of(path: Path) -> str:
    return path.relative_to(ROOT / "slviewer").with_suffix("").parts[0]


def test_imports_run_one_way() -> None:
    against: list[str] = []
    for path in SOURCES:
        layer = layer_of(path)
        if layer == "__init__":  # public names, imported when they are first used
            continue
        for name in imports_of(path):
            package = package_of(name)
            upwards = package is not None and PACKAGES.index(package) > PACKAGES.index(layer)
            if upwards or any(
                layer == importer and name.startswith(imported) for importer, imported in FORBIDDEN
            ):
                against.append(f"{path.relative_to(ROOT)} imports {name}")
    assert not against


def module_graph() -> dict[str, set[str]]:
    """{module: modules that it imports}, also inside functions and for type checking alone."""
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in SOURCES}
    names.pop("slviewer.__init__")
    graph = {}
    for module, path in names.items():
        imported = imports_of(path)
        parents = {name.rpartition(".")[0] for name in imported}
        graph[module] = (imported | parents) & names.keys() - {module}
    return graph


def test_no_modules_import_each_other() -> None:
    order = TopologicalSorter(module_graph())
    try:
        order.prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_every_package_has_its_layer_and_none_outgrows_the_others() -> None:
    lines = Counter[str]()
    for path in SOURCES:
        lines[layer_of(path)] += len(path.read_text().splitlines())
    assert set(lines) - {"__init__"} == set(PACKAGES)
    shares = {package: n / lines.total() for package, n in lines.items()}
    assert max(shares.values()) <= MOST_SHARE, shares


def test_the_architecture_page_lists_the_packages_in_their_order() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    table = [line.split("`")[1] for line in page.splitlines() if line.startswith("| `")]
    assert table == PACKAGES


def test_numeric_packages_know_no_device_and_no_browser() -> None:
    banned = {"viser", "zarr", "tyro", "websockets", "jinja2", "matplotlib"}
    numeric = [path for path in SOURCES if layer_of(path) in NUMERIC]
    assert not [
        path for path in numeric if banned & {name.split(".")[0] for name in imports_of(path)}
    ]


def test_files_can_be_read_in_one_sitting() -> None:
    for path in SOURCES:
        if (n := len(path.read_text().splitlines())) > MANY_LINES:
            warnings.warn(
                f"{path.relative_to(ROOT)} has {n} lines: one reason a file", stacklevel=1
            )


def count_branches(function: ast.AST) -> int:
    """Decisions in a function, without those of functions inside it."""
    inside = [
        n
        for n in ast.walk(function)
        if isinstance(n, ast.FunctionDef | ast.Lambda) and n is not function
    ]
    hidden = {id(node) for each in inside for node in ast.walk(each)}
    own = [node for node in ast.walk(function) if id(node) not in hidden]
    chained = sum(len(node.values) - 1 for node in own if isinstance(node, ast.BoolOp))
    return chained + sum(isinstance(node, DECISIONS) for node in own)


def is_kernel(function: ast.FunctionDef) -> bool:
    """Whether numba compiles a function: it has no objects for arguments."""
    names = "".join(map(ast.unparse, function.decorator_list))
    return "jit" in names or "kernel" in names


def test_functions_can_be_followed() -> None:
    """Few have many branches or parameters, and none more than before."""
    branches, parameters = [], []
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.FunctionDef):
                continue
            place, given = f"{path.relative_to(ROOT)}: {node.name}", node.args
            if count_branches(node) > MANY_BRANCHES:
                branches.append(place)
            count = len(given.args) + len(given.kwonlyargs) + len(given.posonlyargs)
            if count > MANY_PARAMETERS and not is_kernel(node):
                parameters.append(place)
    assert len(branches) <= MOST_WITH_MANY_BRANCHES, branches
    assert len(parameters) <= MOST_WITH_MANY_PARAMETERS, parameters


def test_test_modules_have_names_of_their_own() -> None:
    """Two of one name cannot be collected together, as the folders are no packages."""
    names = Counter(path.name for path in (ROOT / "tests").rglob("test_*.py"))
    assert not [name for name, count in names.items() if count > 1]


def test_ci_checks_style_types_and_site_and_runs_the_readmes_test_command() -> None:
    ci = (ROOT / ".ci" / "run").read_text()
    commands = [
        line
        for line in (ROOT / "README.md").read_text().splitlines()
        if "pytest" in line and ".venv" in line
    ]
    assert commands and commands[0] in map(str.strip, ci.splitlines())
    steps = ("mypy", "mypy --platform win32", "mypy --strict", "pytest -m slow", "sphinx -W")
    assert all(f".venv/bin/python -m {step}" in ci for step in steps)
    assert all(
        f".venv/bin/{step}" in ci for step in ("ruff check .", "ruff format --check .", "hadolint")
    )


@pytest.mark.process
def test_the_first_import_is_light() -> None:
    heavy = "{'numpy', 'cv2', 'numba', 'scipy', 'open3d', 'zarr', 'matplotlib'}"
    code = f"import sys, slviewer.cli; sys.exit(bool({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0
