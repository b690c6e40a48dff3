"""Our methods, by name, and the exact answer of each world.

Each is a list of candidates, of which the harness takes the one with the least error on other runs
of the same stream: one candidate where there is nothing to tune.
"""

from typing import Any, NamedTuple

import numpy as np

import ewif_jax as ej
from benchmarks.oosm.streams import LAG, World

MEMBERS, PARTICLES = 100, 500


class Ours(NamedTuple):
    """An estimator and its parameters. sees_labels: whether it is told which are outliers."""

    estimator: ej.Estimator
    params: dict[str, float]
    sees_labels: bool = False


def process_noise(params: dict[str, float]) -> Any:
    """q, so that worlds with another share their programs."""
    return params["q"]


def decay_time(params: dict[str, float]) -> Any:
    """tau of an EWIF."""
    return params["tau"]


def model_of(world: World, q: Any = process_noise, labelled: bool = False) -> ej.Model:
    """The world as a model; its sensor 1, where there is one, is that of outliers."""
    noises = [world.R, world.R + world.outlier * np.eye(2)][: 1 + labelled]
    if world.is_linear:
        seen = [ej.models.position_sensor(R, dims=2) for R in noises]
    else:
        seen = [ej.models.range_bearing_sensor(R) for R in noises]
    return ej.models.constant_velocity(dims=2, q=q, sensors=seen)


def modes(world: World) -> ej.Estimator:
    """A filter for each way of moving, mixed."""
    stays, leaves = 1 - world.leaves, world.leaves
    filters = [ej.kalman(model_of(world, q)) for q in world.modes]
    return ej.imm(filters, np.array([[stays, leaves], [leaves, stays]]))


def reference(world: World) -> Ours:
    """The optimal filter of the world with everything in its order: exact where it is linear and
    Gaussian (given which are outliers), the best that is known where stamps err (first order),
    where the sensor is nonlinear (sigma points), and where the target manoeuvres (two moments of
    the mixture)."""
    params = {"q": world.q}
    if world.modes:
        return Ours(ej.replay(modes(world), LAG), params)
    labelled = world.outlier > 0
    model = model_of(world, labelled=labelled)
    if world.jitter:
        model = ej.models.jittered(model, world.jitter)
    base = ej.kalman(model) if world.is_linear else ej.unscented(model)
    return Ours(ej.replay(base, LAG), params, labelled)


def methods(world: World) -> dict[str, list[Ours]]:
    """All that can filter this world, by the name of their row."""
    model = model_of(world)
    found = of_points(world, model) | of_clouds(world, model)
    rows = {name: [Ours(method, {"q": world.q})] for name, method in found.items()}
    linearised = None if world.is_linear else "extended"
    weighted = ej.ewif(model, decay_time, linearisation=linearised)
    taus = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
    rows["ewif (tuned)"] = [Ours(weighted, {"q": world.q, "tau": tau}) for tau in taus]
    return rows


def of_points(world: World, model: ej.Model) -> dict[str, ej.Estimator]:
    """Those of a mean and a covariance."""
    base = ej.kalman(model) if world.is_linear else ej.extended(model)
    found = {
        "replay": ej.replay(base, LAG),
        "asd": ej.asd(model, LAG),
        "al1": ej.al1(model, LAG),
        "bl1": ej.bl1(model, LAG),
        "a1": ej.a1(model),
        "b1": ej.b1(model),
        "selective(al1)": ej.selective(ej.al1(model, LAG), 4.0),
        "drop_late": ej.drop_late(base),
        "replay(gated)": ej.replay(ej.gated(base), LAG),
        "replay(robust)": ej.replay(ej.robust(base, 3.0), LAG),
    }
    if world.is_linear:
        found["rts_reference"] = ej.rts_reference(model, LAG)
    if world.jitter:
        found["asd (jitter known)"] = ej.asd(ej.models.jittered(model, world.jitter), LAG)
    if world.modes:
        found["replay(imm)"] = ej.replay(modes(world), LAG)
        found["drop_late(imm)"] = ej.drop_late(modes(world))
    return found


def of_clouds(world: World, model: ej.Model) -> dict[str, ej.Estimator]:
    """Ensembles and particles: some where a Kalman filter is exact, all where none is."""
    found = {
        "enkf2 (100)": ej.enkf2(model, MEMBERS, LAG, "shared"),
        "pf_extended (500)": ej.pf_extended(model, PARTICLES, LAG),
    }
    if not world.is_linear:
        found["enkf1 (100)"] = ej.enkf1(model, MEMBERS, LAG)
        found["pf_retrodict (500)"] = ej.pf_retrodict(model, PARTICLES)
        found["pf_fixed_point (500)"] = ej.pf_fixed_point(model, PARTICLES, LAG)
    return found
