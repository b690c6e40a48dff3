"""The rooms of the package, their one direction of imports, and what importing it does."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import ewif_jax

ROOT = Path(ewif_jax.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))

RANKS = (
    {"recipe"},
    {"types"},
    {"checks"},
    {"plain"},
    {"fast"},
    {"kernels"},
    {"models"},
    {"clocks"},
    {"streams"},
    {"arrival"},
    {"trial"},
    {"estimator", "every_run"},
    {"recursions", "batch"},
    {"estimators"},
    {"oosm", "smoothers", "analysis", "parallel"},
    {"scores", "continuous", "charges"},
    {"charging"},
    {"losses", "transforms"},
    {"tuning", "monte_carlo"},
    {"scenarios"},
    {"study"},
    {"__init__", "__main__"},
)
STRANGERS = {"estimators", "oosm"}
"""Rooms whose files do not import each other."""
SHARED = "oosm.parts"
"""What they share; it knows none of them."""


def module(file: Path) -> str:
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def room(name: str) -> str:
    return name.split(".")[0]


def rank(name: str) -> int:
    return next(k for k, rooms in enumerate(RANKS) if room(name) in rooms)


def imported(file: Path) -> list[str]:
    """Modules of ours that a file imports anywhere, inside functions too."""
    found = []
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            base = node.module or ""
            for alias in node.names:
                inner = f"{base}.{alias.name}".removeprefix("ewif_jax.").replace(".", "/")
                is_module = (ROOT / f"{inner}.py").exists() or (ROOT / inner).is_dir()
                found.append(f"{base}.{alias.name}" if is_module else base)
    ours = (name for name in found if name.split(".")[0] == "ewif_jax")
    return [name.removeprefix("ewif_jax").removeprefix(".") or "__init__" for name in ours]


def test_every_file_lives_in_a_known_room():
    known = set().union(*RANKS)
    assert {room(module(file)) for file in FILES} <= known


@pytest.mark.parametrize("file", FILES, ids=module)
def test_imports_go_one_way(file):
    here = module(file)
    for name in imported(file):
        if room(name) == room(here):
            continue
        assert rank(name) < rank(here), f"{here} imports {name}"


@pytest.mark.parametrize("file", FILES, ids=module)
def test_files_of_one_room_are_strangers_where_each_is_a_published_method(file):
    here = module(file)
    if room(here) not in STRANGERS:
        return
    siblings = [name for name in imported(file) if room(name) == room(here)]
    siblings = [name for name in siblings if not name.startswith(SHARED)]
    assert siblings in ([], [room(here)]), f"{here} imports {siblings}"


def test_the_checker_sees_imports_inside_functions(tmp_path):
    source = tmp_path / "a.py"
    source.write_text(
        "def f():\n    from ewif_jax import tuning\n    import ewif_jax.oosm.asd\n"
        "from ewif_jax.models.model import Model\n"
    )
    assert sorted(imported(source)) == ["models.model", "oosm.asd", "tuning"]


@pytest.mark.parametrize("name", ewif_jax.__all__)
def test_every_public_name_exists_and_is_documented(name):
    doc = getattr(ewif_jax, name).__doc__
    assert doc is not None
    assert len(doc.strip()) > 10


def test_public_names_are_sorted_and_nothing_public_is_left_out():
    assert list(ewif_jax.__all__) == sorted(set(ewif_jax.__all__))
    rooms = {next(iter(file.relative_to(ROOT).parts)).removesuffix(".py") for file in FILES}
    public = {name for name in vars(ewif_jax) if not name.startswith("_")} - rooms
    assert public <= set(ewif_jax.__all__)


@pytest.mark.parametrize("file", FILES, ids=module)
def test_every_file_and_public_function_has_a_docstring(file):
    tree = ast.parse(file.read_text())
    assert ast.get_docstring(tree), module(file)
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{module(file)}.{node.name}"


@pytest.mark.parametrize("file", FILES, ids=module)
def test_a_file_reads_in_one_sitting(file):
    assert len(file.read_text().splitlines()) <= 330


IMPORT = """
import sys
import jax, optax
before = dict(jax.config.values)
loaded = set(sys.modules)
import ewif_jax
assert dict(jax.config.values) == before, "importing changed the configuration of JAX"
assert jax.numpy.zeros(1).dtype == "float32"
print(*sorted({name.split(".")[0] for name in set(sys.modules) - loaded}))
"""


def test_importing_changes_no_setting_and_brings_nothing_but_the_dependencies():
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", IMPORT], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    third_party = set(done.stdout.split()) - set(sys.stdlib_module_names)
    assert third_party <= {"ewif_jax", "jax", "jaxlib", "numpy", "optax", "ml_dtypes", "opt_einsum"}


FIELDS = {"init", "predict", "update", "estimate", "series"}
"""Of an `Estimator`: a wrapper that changes one of them builds a new one, which has no `series`."""


@pytest.mark.parametrize("file", FILES, ids=module)
def test_no_estimator_is_changed_in_place(file):
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            fields = {keyword.arg for keyword in node.keywords}
            called = node.func.attr == "_replace"
            assert not (called and fields & FIELDS), f"{module(file)}:{node.lineno}"


BUILT = ("Estimator", "Model", "Scenario", "Sensor", "Transform")


@pytest.mark.parametrize("file", FILES, ids=module)
def test_what_a_public_builder_makes_knows_its_recipe(file):
    if room(module(file)) in ("recursions", "study") or module(file).startswith(SHARED):
        return  # parts of builders
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            builds = isinstance(node.returns, ast.Name) and node.returns.id in BUILT
            names = {d.id for d in node.decorator_list if isinstance(d, ast.Name)}
            assert not builds or "from_recipe" in names, f"{module(file)}.{node.name}"
