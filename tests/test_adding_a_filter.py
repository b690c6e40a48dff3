"""docs/adding-a-filter.md is true: one file, one export and one row make a filter."""

import re
from inspect import signature
from pathlib import Path

import numpy as np
import pytest
from contracts import registry, test_contract
from contracts.registry import Row

import ewif_jax

GUIDE = (Path(__file__).parents[1] / "docs" / "adding-a-filter.md").read_text()
FILE, EXPORT, ROW = re.findall(r"```python\n(.*?)```", GUIDE, re.DOTALL)
KALMAN = '''
"""Kalman again."""
from ewif_jax.recursions.covariance import covariance_form
def again(model):
    """The Kalman filter under another name."""
    return covariance_form(model, "again")
'''
CLAIMS = [
    claim
    for name, claim in vars(test_contract).items()
    if name.startswith("test_") and list(signature(claim).parameters) == ["row"]
]


def defined(source, name):
    """The function that a file of this source would export."""
    space = {"__name__": "ewif_jax.estimators.new"}
    exec(compile(source, "new.py", "exec"), space)
    return space[name]


@pytest.fixture(scope="module")
def rows():
    """The row of the guide, evaluated where it would stand, and Kalman under another name."""
    scope = {**vars(registry), "np": np, "constant_gain": defined(FILE, "constant_gain")}
    (guide,) = eval(f"({ROW.strip()})", scope)
    return {"guide": guide, "again": Row("again", defined(KALMAN, "again"))}


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.__name__)
@pytest.mark.parametrize("name", ["guide", "again"])
def test_the_new_filter_keeps_the_contract(rows, name, claim):
    claim(rows[name])


def test_the_export_is_where_the_others_are():
    package = Path(ewif_jax.__file__).parent / "__init__.py"
    pattern = re.escape(EXPORT.strip()).replace("constant_gain", "kalman")
    assert re.search(pattern, package.read_text())
    assert "kalman" in ewif_jax.__all__
