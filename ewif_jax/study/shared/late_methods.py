"""Every method for late measurements, built for a state of any size, and what it has to store."""

from typing import Any

import numpy as np

from ewif_jax.analysis.storage import Storage, storage
from ewif_jax.estimators.bootstrap import bootstrap
from ewif_jax.estimators.ensemble import ensemble
from ewif_jax.estimators.ewif import ewif
from ewif_jax.estimators.kalman import kalman
from ewif_jax.models import linear_model
from ewif_jax.oosm.a1 import a1
from ewif_jax.oosm.al1 import al1
from ewif_jax.oosm.asd import asd
from ewif_jax.oosm.b1 import b1
from ewif_jax.oosm.bl1 import bl1
from ewif_jax.oosm.drop_late import drop_late
from ewif_jax.oosm.enkf1 import enkf1
from ewif_jax.oosm.enkf2 import enkf2
from ewif_jax.oosm.pf_extended import pf_extended
from ewif_jax.oosm.pf_fixed_point import pf_fixed_point
from ewif_jax.oosm.pf_retrodict import pf_retrodict
from ewif_jax.oosm.replay import replay
from ewif_jax.oosm.rts_reference import rts_reference
from ewif_jax.oosm.selective import selective
from ewif_jax.types import Estimator


def late_methods(
    n: int, m: int, *, lag: int, members: int, particles: int
) -> dict[str, tuple[Estimator, Estimator]]:
    """Each method by name, and the filter in sequence it extends, for n states and m measured
    numbers; `lag` is what each calls by that name."""
    model = linear_model(np.eye(n), np.eye(m, n), np.eye(m), np.eye(n))
    gauss, cloud, few = kalman(model), bootstrap(model, particles), ensemble(model, members)
    fading = ewif(model, tau=1.0)
    smoothers: Any = ("eks", "uks", "ps")
    return {
        "drop_late": (drop_late(gauss), gauss),
        "a1": (a1(model), gauss),
        "b1": (b1(model), gauss),
        "al1": (al1(model, lag), gauss),
        "bl1": (bl1(model, lag), gauss),
        "selective al1": (selective(al1(model, lag), 1.0), gauss),
        "rts_reference": (rts_reference(model, lag), gauss),
        "asd": (asd(model, lag), gauss),
        "replay": (replay(gauss, lag, width=m), gauss),
        "ewif": (fading, fading),
        "enkf1": (enkf1(model, members, lag), few),
        "enkf2, fresh": (enkf2(model, members, lag), few),
        "enkf2, shared": (enkf2(model, members, lag, "shared"), few),
        "pf_retrodict": (pf_retrodict(model, particles), cloud),
        "pf_extended": (pf_extended(model, particles, lag), cloud),
        **{
            f"pf_fixed_point, {one}": (pf_fixed_point(model, particles, lag, one), cloud)
            for one in smoothers
        },
        "replay of bootstrap": (replay(cloud, lag, width=m), cloud),
    }


def storage_rows(
    n: int, m: int, *, lag: int, members: int = 250, particles: int = 10_000
) -> list[dict[str, Any]]:
    """The rows of a table: numbers each method holds, and how many of them only because data may
    be late."""
    methods = late_methods(n, m, lag=lag, members=members, particles=particles)
    held: dict[str, tuple[Storage, Storage]] = {
        name: (storage(late, n), storage(base, n)) for name, (late, base) in methods.items()
    }
    return [
        {
            "method": name,
            "numbers": late.numbers,
            "for late data": late.numbers - base.numbers,
            "bytes": late.bytes,
        }
        for name, (late, base) in held.items()
    ]
