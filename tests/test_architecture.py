"""The rooms of the package, their one direction of imports, and what importing it does."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import ewif_jax

ROOT = Path(ewif_jax.__file__).parent
FILES = sorted(ROOT.rglob("*.py"))
MAP = (Path(__file__).parents[1] / "docs" / "architecture.md").read_text()


def listed(block: str) -> list[str]:
    """The lines of a block of docs/architecture.md."""
    (found,) = re.findall(rf"```{block}\n(.*?)\n```", MAP, re.DOTALL)
    return found.splitlines()


RANKS = {room: k for k, rooms in enumerate(listed("order")) for room in rooms.split()}
"""How far down the order of imports a room is; what is on one line has one rank."""
STRANGERS = {line.split()[0]: set(line.split()[2:]) for line in listed("strangers")}
"""Rooms whose files do not import each other, and what of them all may import."""


def module(file: Path) -> str:
    return ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def room(name: str) -> str:
    return name.split(".")[0]


def imported(source: str) -> list[str]:
    """Modules of ours that a source imports anywhere, inside functions too."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            base = node.module or ""
            for alias in node.names:
                inner = f"{base}.{alias.name}".removeprefix("ewif_jax.").replace(".", "/")
                is_module = (ROOT / f"{inner}.py").exists() or (ROOT / inner).is_dir()
                found.append(f"{base}.{alias.name}" if is_module else base)
    ours = (name for name in found if name.split(".")[0] == "ewif_jax")
    return [name.removeprefix("ewif_jax").removeprefix(".") or "__init__" for name in ours]


def refused(here: str, source: str) -> list[str]:
    """What the module `here` with this source must not import."""
    names = [name for name in imported(source) if name != here]
    upward = [n for n in names if room(n) != room(here) and RANKS[room(n)] >= RANKS[room(here)]]
    if room(here) not in STRANGERS or here == room(here):
        return upward
    shared = tuple(STRANGERS[room(here)])
    siblings = [n for n in names if room(n) == room(here) and not n.startswith(shared)]
    return upward + siblings


def test_every_file_lives_in_a_room_of_the_map():
    assert {room(module(file)) or "__init__" for file in FILES} == set(RANKS)


@pytest.mark.parametrize("name", sorted(set(RANKS) - {"__main__"}))
def test_the_map_says_what_is_in_a_room(name):
    home = name if (ROOT / name).is_dir() else f"{name}.py"
    assert re.search(rf"^\| .*`{home}/?`.* \|", MAP, re.MULTILINE), home


@pytest.mark.parametrize("file", FILES, ids=module)
def test_imports_go_one_way_and_published_methods_are_strangers(file):
    assert refused(module(file), file.read_text()) == []


PLANTED = {
    "upward": ("models/sensors.py", "from ewif_jax.recursions import covariance"),
    "upward, of one line": ("scores.py", "from ewif_jax.continuous.error import anything"),
    "upward, of the face": ("losses.py", "import ewif_jax"),
    "upward, inside a function": ("kernels/gaussian.py", "def f():\n    import ewif_jax.oosm.asd"),
    "a sibling": ("estimators/fading.py", "from ewif_jax.estimators.kalman import kalman"),
    "a sibling by its room": ("oosm/a1.py", "from ewif_jax.oosm import asd"),
    "a model, in fast": ("fast/loops.py", "from ewif_jax.models.model import Model"),
    "a kernel, in fast": ("fast/small.py", "from ewif_jax.kernels import gaussian"),
    "a filter, in fast": ("fast/memo.py", "from ewif_jax.estimators.kalman import kalman"),
}


@pytest.mark.parametrize("planted", PLANTED.values(), ids=PLANTED)
def test_a_planted_import_is_refused(planted):
    place, line = planted
    file = ROOT / place
    source = file.read_text()
    assert refused(module(file), f"{source}\n{line}\n") == imported(line)


def test_what_methods_share_is_not_refused():
    line = (
        "from ewif_jax.oosm.parts.history import anything\nfrom ewif_jax.recursions import contract"
    )
    assert refused("oosm.new", line) == []


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
OFFERED = {
    *ewif_jax.__all__,
    *ewif_jax.models.__all__,
    *ewif_jax.scenarios.__all__,
    *ewif_jax.analysis.__all__,
    *ewif_jax.continuous.__all__,
    *(name for name in vars(ewif_jax.transforms) if not name.startswith("_")),
}
"""What a user can call; the rest are parts of builders."""


@pytest.mark.parametrize("file", FILES, ids=module)
def test_what_a_public_builder_makes_knows_its_recipe(file):
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.FunctionDef) and node.name in OFFERED:
            builds = isinstance(node.returns, ast.Name) and node.returns.id in BUILT
            names = {d.id for d in node.decorator_list if isinstance(d, ast.Name)}
            assert not builds or "from_recipe" in names, f"{module(file)}.{node.name}"
