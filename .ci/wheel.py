"""Checks what `python -m build` has made: contents, metadata, and the wheel alone in an environment
of its own, where the quickstart of the front page has to print what it says within 10 s.

usage: wheel.py DIST
"""

import re
import subprocess
import sys
import tarfile
import tempfile
import time
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST_SECONDS = 10.0
LARGEST = 1_000_000


def front_page():
    """The code of the front page, and what its lines print."""
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/index.md").read_text(), re.DOTALL)
    return code, re.findall(r"^print\(.*\)  # (.*)$", code, re.MULTILINE)


def check_contents(wheel, source):
    """Every module is in both, and nothing that is no part of the package is in the wheel."""
    modules = {str(p.relative_to(ROOT)) for p in (ROOT / "ewif_jax").rglob("*.py")}
    packed = zipfile.ZipFile(wheel)
    names = {name for name in packed.namelist() if ".dist-info/" not in name}
    assert modules <= names, sorted(modules - names)
    strays = {n for n in names if not n.startswith(("ewif_jax/", "ewif_jax_command.py"))}
    assert not strays, strays
    assert "ewif_jax/py.typed" in names
    assert max(x.file_size for x in packed.infolist()) < LARGEST
    with tarfile.open(source) as archive:
        kept = {name.split("/", 1)[-1] for name in archive.getnames()}
    wanted = {*modules, "LICENSE", "CHANGELOG.md", "CITATION.cff", "README.md"}
    assert wanted <= kept, sorted(wanted - kept)


def check_alone(wheel):
    """Installs the wheel, with what it asks for, and runs the front page."""
    code, said = front_page()
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        python = Path(folder) / "bin" / "python"
        install = [python, "-m", "pip", "install", "--quiet", str(wheel)]
        subprocess.run(install, check=True)
        # Modules are compiled to bytecode once, on the first import.
        subprocess.run([python, "-c", "import ewif_jax"], check=True, cwd=folder)
        start = time.perf_counter()
        done = subprocess.run([python, "-c", code], capture_output=True, text=True, cwd=folder)
        seconds = time.perf_counter() - start
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == said, done.stdout
    assert seconds < MOST_SECONDS, f"{seconds:.1f} s"
    print(f"The front page's code from the wheel alone: {seconds:.1f} s.")


dist = Path(sys.argv[1])
(wheel,), (source,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
check_contents(wheel, source)
check_alone(wheel)
print(f"{wheel.name} and {source.name} are whole.")
