"""Prints the lower bounds of pyproject.toml as constraints for pip: the oldest set of packages.

usage: oldest.py            of the package itself
       oldest.py lab study  of these extras too
"""

import re
import sys
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
BOUND = re.compile(r"([A-Za-z0-9_.-]+)>=([0-9.]+)")


def bounds(requirements):
    """(name, version) of what has a lower bound."""
    return [found.groups() for found in map(BOUND.match, requirements) if found]


extras = project["optional-dependencies"]
wanted = [*project["dependencies"], *(x for name in sys.argv[1:] for x in extras[name])]
for name, version in bounds(wanted):
    print(f"{name}=={version}")
    if name == "jax":
        print(f"jaxlib=={version}")
