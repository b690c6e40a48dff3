r"""Time late data (L2): ``python -m benchmarks.bench_late [--quick]``.

Irregular times, process noise and decay time differ by run; 30 % of the measurements are late.
The peer is EWIF written straightforwardly: one step with `jnp.linalg`, scanned, then vmapped,

.. math:: P_k^{-1} = e^{-(t_k - t_m)/\tau} A' P_m^{-1} A
          + e^{-(t_k - t_d)/\tau} A_d' H' R^{-1} H A_d,

with the estimate solved from the information vector at every report. `in sequence` is the same
data sorted by time: its ratio to the late row is the price of a late update. `longer delays` are
drawn ten times as long: no method's cost may depend on them.
"""

import argparse
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import ewif_jax as ej
from benchmarks import ours
from benchmarks.timing import measure, report
from benchmarks.workloads import L2, irregular_and_late

OUTPUT = Path(__file__).parent / "results" / "late.json"
PLAIN, KALMAN = "plain vmapped EWIF", "drop_late(kalman)"
TAU = 2.0


def main() -> None:
    """Time every method on the late stream, EWIF on the sorted one too, and compare the means."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, help="1024, or 64 with --quick")
    parser.add_argument("--steps", type=int, help="1000, or 100 with --quick")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    ej.prepare_cpu(1)
    runs = options.runs or (64 if options.quick else 1024)
    steps = options.steps or (100 if options.quick else 1000)
    late = irregular_and_late(runs, steps)
    longer = irregular_and_late(runs, steps, mean_delay=3.0)
    ordered = in_sequence(late)
    tau = np.geomspace(TAU / 2, TAU * 2, runs).astype(np.float32)
    ewif, noisy = {"tau": tau}, {"q": late.q}
    model, lag = ours.model(), 8

    def row(estimator, params, workload):
        return ours.batch_filter(estimator, params, workload, per_run=True)

    decay, one_step = ej.ewif(model, lambda p: p["tau"]), ej.al1(model, lag)
    filters = {
        PLAIN: partial(plain_ewif, late, tau),
        "ewif": row(decay, ewif, late),
        "ewif, in sequence": row(decay, ewif, ordered),
        KALMAN: row(ej.drop_late(ej.kalman(model)), noisy, late),
        "ewif, longer delays": row(decay, ewif, longer),
        "al1": row(one_step, noisy, late),
        "al1, longer delays": row(one_step, noisy, longer),
        "al1, lag 32": row(ej.al1(model, 32), noisy, late),
        "asd": row(ej.asd(model, lag), noisy, late),
        "replay(kalman)": row(ej.replay(ej.kalman(model), lag), noisy, late),
    }
    results = []
    for name, times in measure(filters, options.repeat, budget=20.0).items():
        results.append(
            {"workload": "L2", "name": name, "run_steps": runs * steps, "note": ""} | times
        )
    gap = np.abs(np.asarray(filters["ewif"]()) - np.asarray(filters[PLAIN]()))[
        :, steps // 2 :
    ].max()
    results[1]["note"] = f"largest difference from the plain version {gap:.1e}"
    report(results, options.output, references=(PLAIN, "ewif, in sequence", KALMAN))


def in_sequence(workload: L2) -> L2:
    """The same measurements in the order of their times."""
    order = np.argsort(workload.time, axis=1)

    def sort(x):
        return np.take_along_axis(x, order.reshape(order.shape + (1,) * (x.ndim - 2)), 1)

    return workload._replace(time=sort(workload.time), value=sort(workload.value))


@jax.jit
def plain_ewif(workload: L2, tau: jax.Array) -> jax.Array:
    """Means (runs, steps, 6) at the running maximum of the times, plainly written."""

    def F(dt):
        axis = jnp.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
        axis = axis.at[0, 1].set(dt).at[1, 2].set(dt).at[0, 2].set(dt**2 / 2)
        return jnp.kron(axis, jnp.eye(2))

    def one(time, value, tau):
        def step(state, arrival):
            now, matrix, vector = state
            time, value = arrival
            ahead = jnp.maximum(now, time)
            back = F(now - ahead)
            faded = jnp.exp(-(ahead - now) / tau)
            seen = workload.H @ F(time - ahead)
            weighted = jnp.exp(-(ahead - time) / tau) * seen.T @ jnp.linalg.inv(workload.R)
            matrix = faded * back.T @ matrix @ back + weighted @ seen
            vector = faded * back.T @ vector + weighted @ value
            return (ahead, matrix, vector), jnp.linalg.solve(matrix, vector)

        matrix = jnp.linalg.inv(workload.prior_cov)
        first = jnp.zeros((), time.dtype), matrix, matrix @ workload.prior_mean
        return jax.lax.scan(step, first, (time, value))[1]

    return jax.vmap(one)(workload.time, workload.value, tau)


if __name__ == "__main__":
    main()
