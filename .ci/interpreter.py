"""Prints the path of a CPython, on PATH or of pyenv, that runs and makes environments.

usage: interpreter.py newest        the newest release from 3.11 on
       interpreter.py newer         the same, if it is newer than the one that runs this
       interpreter.py python3.13    the first of that name

Prints nothing if there is none.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

NAME = re.compile(r"python3\.(\d+)")
LOOK = "import ensurepip, sys, venv; print(sys.version_info.minor, sys.version_info.releaselevel)"


def candidates():
    """(minor version, path) of what is called python3.N."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    folders = [*os.environ.get("PATH", "").split(os.pathsep), *sorted(pyenv.glob("3.*/bin"))]
    for folder in folders:
        for path in sorted(Path(folder).glob("python3.*")):
            found = NAME.fullmatch(path.name)
            if found is not None:
                yield int(found[1]), path


def runs(minor, path):
    """Whether it is what its name says: a shim of pyenv may stand for nothing."""
    try:
        done = subprocess.run([path, "-c", LOOK], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.stdout.split() == [str(minor), "final"]


def chosen(asked):
    """Minor versions that would do."""
    if asked == "newest":
        return range(11, 1000)
    if asked == "newer":
        return range(sys.version_info.minor + 1, 1000)
    named = NAME.fullmatch(asked)
    return [int(named[1])] if named else []


minors = chosen(sys.argv[1])
for minor, path in sorted(candidates(), key=lambda found: -found[0]):
    if minor in minors and runs(minor, path):
        print(path)
        break
