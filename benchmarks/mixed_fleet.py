"""What each part of fusing late data is worth: ``python -m benchmarks.mixed_fleet [RUNS]``."""

import sys

import jax
import jax.numpy as jnp
import numpy as np

import ewif_jax as ej
from ewif_jax.scenarios import mixed_fleet, mixed_fleet_model

ej.prepare_cpu()
RUNS = int(sys.argv[1]) if len(sys.argv) > 1 else 400
SCENARIO = mixed_fleet()
LEARN, TEST = (
    ej.simulate_batch(SCENARIO, jax.random.split(jax.random.key(seed), runs))
    for seed, runs in ((1, 40), (2, RUNS))
)
SETTING = {
    "prior": SCENARIO.prior,
    "t0": SCENARIO.t0,
    "latency": lambda p: jnp.stack([0.0, p["latency"], 0.0]),  # of radar, camera, receiver
}


def fleet(late=True, robust=True):
    """Al1 with room for 16 measurements, without what is switched off."""
    method = ej.al1(mixed_fleet_model(q=lambda p: p["q"]), 16)
    method = method if late else ej.drop_late(method)
    return ej.robust(method, 3.0) if robust else method


def tuned(fixed=None):
    """The maximum of the likelihood over the runs to learn from."""
    loss = ej.likelihood_loss(fleet(), LEARN.measurements, **SETTING)
    moves = {"q": ej.transforms.positive(), "latency": ej.transforms.unconstrained()}
    return ej.tune(loss, {"q": 5.0, "latency": 0.0}, transforms=moves, fixed=fixed)


def errors_of(method, params):
    """The RMSE (RUNS,) of the position in m, over all arrivals of a run."""
    trace = ej.run_batch(method, params, TEST.measurements, times=TEST.times, **SETTING)
    squared = np.sum((np.asarray(trace.mean)[..., :2] - np.asarray(TEST.truth)) ** 2, -1)
    return np.sqrt(np.mean(squared, 1))


print(found := tuned())
everything = errors_of(fleet(), found.params)
ROWS = {
    "everything": everything,
    "latency not tuned": errors_of(fleet(), tuned({"latency": 0.0}).params),
    "noise not tuned": errors_of(fleet(), {**found.params, "q": 5.0}),
    "not robust": errors_of(fleet(robust=False), found.params),
    "late data dropped": errors_of(fleet(late=False), found.params),
}
print("| | RMSE, m | more than with everything, m |\n|---|---|---|")
for name, rmse in ROWS.items():
    worse, root = rmse - everything, RUNS**0.5
    cells = (f"{x.mean():.2f} ± {x.std(ddof=1) / root:.2f}" for x in (rmse, worse))
    print(f"| {name} | {' | '.join(cells)} |")
