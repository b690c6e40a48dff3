"""One row per estimator: how to build it on the standard small model, and what it promises.

A new estimator is one more row. `late` says what a late measurement becomes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import ewif_jax as ej
from ewif_jax import Estimator, Gaussian, Measurement, Model, Status
from ewif_jax.estimators.bootstrap import bootstrap
from ewif_jax.estimators.ensemble import ensemble
from ewif_jax.estimators.unscented import unscented
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
from ewif_jax.smoothers.fixed_lag import fixed_lag
from ewif_jax.smoothers.fixed_lag_ewif import fixed_lag_ewif

PARAMS = {
    "q": 0.3,
    "r": 0.5,
    "tau": 1.5,
    "fading": 1.1,
    "window": 2.45,
    "max_delay": 0.77,
    "probability": 0.99999,
    "c": 2.5,
}
LAG = 4
T0 = 0.0
STEPS = 12
LAST = 4.0
"""No time in the standard stream is later."""


def small_model() -> Model:
    """Two states, two sensors of two components, a known input; noise levels from `params`."""
    table = jnp.asarray([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.5], [-0.3, 1.0]]])
    noise = jnp.asarray([[[1.0, 0.2], [0.2, 0.5]], [[0.4, 0.0], [0.0, 2.0]]])

    def F(params: Any, t0: Any, t1: Any) -> jax.Array:
        dt = t1 - t0
        return jnp.stack([jnp.stack([1.0 + 0 * dt, dt]), jnp.stack([0 * dt, 1.0 + 0 * dt])])

    def Q(params: Any, t0: Any, t1: Any) -> jax.Array:
        dt = t1 - t0
        cross = dt**2 / 2
        return params["q"] * jnp.stack([jnp.stack([dt**3 / 3, cross]), jnp.stack([cross, dt])])

    def b(params: Any, t0: Any, t1: Any) -> jax.Array:
        dt = t1 - t0
        return 0.7 * jnp.stack([dt**2 / 2, dt])

    return ej.linear_model(F, table, lambda p, s, t: p["r"] * noise[s], Q, b)


class Row(NamedTuple):
    """name; build(model) -> Estimator; late: the status of a late measurement;
    any_age: late measurements of any age are used; accepts_no_prior; needs_key: draws random
    numbers; differentiable in `params`; predicts_back: predict to an earlier time is a number, not
    NaN; refuses: who refuses a missing prior (default the name); variant: the code of another row
    with another setting, checked with `--all` only."""

    name: str
    build: Callable[[Model], Estimator]
    late: Status = Status.TOO_LATE
    any_age: bool = False
    accepts_no_prior: bool = False
    needs_key: bool = False
    differentiable: bool = True
    predicts_back: bool = False
    refuses: str | None = None
    variant: bool = False


def of(name: str) -> Callable[[Any], Any]:
    """The parameter `name`, read from `params`."""
    return lambda params: params[name]


ROWS = (
    Row("kalman", ej.kalman),
    Row("information", ej.information, accepts_no_prior=True),
    Row("square_root", ej.square_root),
    Row("fading", lambda model: ej.fading(model, of("fading"))),
    Row(
        "ewif",
        lambda model: ej.ewif(model, of("tau")),
        late=Status.LATE_USED,
        any_age=True,
        accepts_no_prior=True,
        predicts_back=True,
    ),
    Row(
        "ewif_directional",
        lambda model: ej.ewif(model, of("tau"), directional=True),
        late=Status.LATE_USED,
        any_age=True,
        accepts_no_prior=True,
        predicts_back=True,
    ),
    *(
        Row(
            f"ewif_{kind}",
            lambda model, kind=kind: ej.ewif(
                model._replace(linear=None), of("tau"), linearisation=kind
            ),
            late=Status.LATE_USED,
            any_age=True,
            predicts_back=True,
            refuses="ewif",
            variant=kind == "sigma-points",
        )
        for kind in ("extended", "sigma-points")
    ),
    Row(
        "ewif_bank",
        lambda model: ej.ewif_bank(model, lambda p: p["tau"] * jnp.asarray([0.5, 1.0, 3.0])),
        late=Status.LATE_USED,
        any_age=True,
        accepts_no_prior=True,
        predicts_back=True,
    ),
    Row(
        "limited_memory",
        lambda model: ej.limited_memory(model, of("window"), 8),
        late=Status.LATE_USED,
        accepts_no_prior=True,
        predicts_back=True,
    ),
    Row("extended", ej.extended),
    Row("iterated_extended", ej.iterated_extended),
    Row("unscented", unscented),
    Row(
        "gauss_hermite",
        lambda model: unscented(model, points="gauss-hermite"),
        refuses="unscented",
        variant=True,
    ),
    Row("ensemble", lambda model: ensemble(model, 20), needs_key=True),
    Row(
        "ensemble_square_root",
        lambda model: ensemble(model, 20, "square_root"),
        needs_key=True,
        refuses="ensemble",
    ),
    Row(
        "enkf1",
        lambda model: enkf1(model, 20, LAG),
        late=Status.LATE_USED,
        needs_key=True,
    ),
    Row(
        "enkf2",
        lambda model: enkf2(model, 20, LAG),
        late=Status.LATE_USED,
        needs_key=True,
        variant=True,
    ),
    Row(
        "enkf2_shared",
        lambda model: enkf2(model, 20, LAG, "shared"),
        late=Status.LATE_USED,
        needs_key=True,
        refuses="enkf2",
    ),
    Row(
        "rts_reference",
        lambda model: rts_reference(model, LAG),
        late=Status.LATE_USED,
    ),
    Row("a1", a1, late=Status.LATE_USED, variant=True),
    Row("b1", b1, late=Status.LATE_USED, variant=True),
    Row("al1", lambda model: al1(model, LAG), late=Status.LATE_USED),
    Row("bl1", lambda model: bl1(model, LAG), late=Status.LATE_USED, variant=True),
    Row("asd", lambda model: asd(model, LAG), late=Status.LATE_USED),
    Row(
        "replay",
        lambda model: replay(ej.kalman(model), LAG),
        late=Status.LATE_USED,
        refuses="kalman",
    ),
    Row(
        "selective",
        lambda model: selective(al1(model, LAG), of("max_delay")),
        late=Status.LATE_USED,
        refuses="al1",
    ),
    Row(
        "drop_late",
        lambda model: drop_late(ej.ewif(model, of("tau"))),
        accepts_no_prior=True,
        predicts_back=True,
    ),
    Row(
        "gated",
        lambda model: ej.gated(al1(model, LAG), of("probability")),
        late=Status.LATE_USED,
        refuses="al1",
    ),
    Row(
        "robust",
        lambda model: ej.robust(ej.ewif(model, of("tau")), of("c")),
        late=Status.LATE_USED,
        any_age=True,
        accepts_no_prior=True,
        predicts_back=True,
    ),
    Row(
        "robust_asd",
        lambda model: ej.robust(asd(model, LAG), of("c"), "student"),
        late=Status.LATE_USED,
        refuses="asd",
        variant=True,
    ),
    Row(
        "imm",
        lambda model: ej.imm(
            [ej.kalman(model), ej.fading(model, of("fading"))],
            lambda p, t0, t1: jnp.exp(t0 - t1) * jnp.eye(2) + (1 - jnp.exp(t0 - t1)) / 2,
        ),
    ),
    Row("fixed_lag", lambda model: fixed_lag(model, 2)),
    Row("bootstrap", lambda model: bootstrap(model, 64), needs_key=True, differentiable=False),
    Row("guided", lambda model: ej.guided(model, 64), needs_key=True, differentiable=False),
    Row(
        "pf_retrodict",
        lambda model: pf_retrodict(model, 64),
        late=Status.LATE_USED,
        any_age=True,
        needs_key=True,
        differentiable=False,
    ),
    Row(
        "pf_extended",
        lambda model: pf_extended(model, 64, LAG),
        late=Status.LATE_USED,
        needs_key=True,
        differentiable=False,
    ),
    *(
        Row(
            f"pf_fixed_point_{smoother}",
            lambda model, smoother=smoother: pf_fixed_point(model, 64, LAG, smoother),
            late=Status.LATE_USED,
            needs_key=True,
            differentiable=False,
            refuses="pf_fixed_point",
            variant=smoother == "uks",
        )
        for smoother in ("eks", "uks", "ps")
    ),
    Row(
        "fixed_lag_ewif",
        lambda model: fixed_lag_ewif(model, of("tau"), lag=0.5),
        late=Status.LATE_USED,
        any_age=True,
        accepts_no_prior=True,
        predicts_back=True,
        variant=True,
    ),
)


def standard_prior() -> Gaussian:
    return Gaussian(np.array([0.4, -1.0]), np.array([[2.0, 0.3], [0.3, 0.5]]))


def standard_stream(dtype: Any = np.float64) -> Measurement:
    """Twelve arrivals: irregular, one repeated time, padding at 3, two late ones (6 and 9), and
    partial masks."""
    rng = np.random.default_rng(7)
    time = np.array([0.3, 0.7, 1.0, 1.2, 1.2, 1.9, 1.5, 2.0, 2.6, 2.3, 3.1, 3.6])
    mask = np.ones((12, 2), bool)
    mask[3] = False
    mask[[1, 8], 0] = False
    mask[[5, 9], 1] = False
    return Measurement(
        jnp.asarray(time, dtype),
        jnp.asarray(rng.normal(size=(12, 2)), dtype),
        jnp.asarray(rng.integers(0, 2, 12), jnp.int32),
        jnp.asarray(mask),
    )


LATE = (6, 9)
PADDING = 3
