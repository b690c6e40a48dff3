"""What a user meets: public names, rooms, old names for one release, and a quick import."""

import inspect
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import ewif_jax as ej

ROOT = Path(ej.__file__).parent
ROOMS = {
    "analysis": [
        "Case",
        "alpha_beta_eigenvalues",
        "chi2_band",
        "error_bounds",
        "fuse_ensembles",
        "pcrlb_equivalent",
        "spectral_abscissa",
        "spectral_radius",
        "weighted_covariances",
        "weighting_as_process_noise",
    ],
    "continuous": [
        "actual_error_continuous",
        "error_bounds_continuous",
        "steady_state_continuous",
        "weighting_as_input_noise",
    ],
    "transforms": ["positive", "psd", "unconstrained"],
}
PUBLIC = {*ROOMS, "losses", "models", "scenarios", "scores"}


@pytest.mark.parametrize(("room", "name"), [(r, n) for r, names in ROOMS.items() for n in names])
def test_an_old_name_works_and_says_where_it_went(room, name):
    assert name not in ej.__all__
    with pytest.warns(DeprecationWarning, match=rf"ewif_jax\.{room}\.{name}") as caught:
        old = getattr(ej, name)
    assert old is getattr(getattr(ej, room), name)
    assert caught[0].filename == __file__
    with pytest.warns(DeprecationWarning, match=rf"ewif_jax\.{room}\.{name}"):
        exec(f"from ewif_jax import {name}", {})


def test_the_rooms_are_public():
    assert set(ej.__all__) >= PUBLIC
    assert {name for name, x in vars(ej).items() if inspect.ismodule(x)} >= PUBLIC
    for room in ("analysis", "continuous"):
        names = getattr(ej, room).__all__
        assert names == sorted(names)
        assert all(getattr(ej, room).__dict__[name].__doc__ for name in names)
    assert ej.continuous.kalman_bucy is ej.kalman_bucy
    assert ej.analysis.steady_state_gain is ej.steady_state_gain
    assert ej.losses.rmse_loss is ej.rmse_loss
    assert ej.transforms.Transform is ej.Transform


def test_internal_modules_do_not_complete():
    offered = {name for name in dir(ej) if not name.startswith("__")}
    assert {name for name in offered if inspect.ismodule(getattr(ej, name))} <= PUBLIC | {"lab"}
    assert set(ej.__all__) <= offered <= {*ej.__all__, "lab"}


def test_every_name_offered_is_there_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert inspect.getmembers(ej)


def test_the_laboratory_says_what_to_install():
    if (ROOT / "lab").exists():
        assert ej.lab
        return
    with pytest.raises(ImportError, match=r"pip install ewif_jax\[lab\]"):
        _ = ej.lab


def test_what_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'kalmann'"):
        _ = ej.kalmann
    assert not hasattr(ej, "kalmann")


def test_type_checkers_are_told():
    assert (ROOT / "py.typed").exists()


QUICK = """
import time
import jax, jax.numpy, numpy
begin = time.process_time()  # of this process alone, whatever else the machine does
import ewif_jax
print(time.process_time() - begin)
"""


@pytest.mark.slow  # what other processes do at the same time counts too
def test_importing_takes_a_third_of_a_second():
    command = [sys.executable, "-c", QUICK]
    took = min(float(subprocess.check_output(command)) for _ in range(5))
    assert took <= 0.35
