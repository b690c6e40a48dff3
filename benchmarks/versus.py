"""Two versions of the package in turns: ``python benchmarks/versus.py OTHER_CHECKOUT``.

Each version runs in a process of its own, on the same seeded workloads; the two take turns call by
call, so that what else the machine does falls on both alike; processor time hardly sees it. A ratio
is the time of the other checkout over that of this one, per turn; its median is printed: above 1
this one is faster.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent.parent
Call = Callable[[], Any]


def main() -> None:
    """Print a table of rows: times of both versions and the ratio; first calls below it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("other", type=Path)
    parser.add_argument("--repeat", type=int, default=9)
    parser.add_argument("--rows", nargs="*", help="those whose name contains one of these")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        answer_requests()
        return
    both = [Version(root) for root in (options.other.resolve(), HERE)]
    names = both[1].ask("names")
    if options.rows:
        names = [name for name in names if any(part in name for part in options.rows)]
    head = f"{'row':26s} {'other ms':>10s} {'this ms':>10s} {'ratio':>7s} {'of CPU':>7s}"
    print(f"{head} {'first calls, CPU s':>22s}")
    for name in names:
        first = [version.ask(name)[1] for version in both]
        turns = [[version.ask(name) for version in both] for _ in range(options.repeat)]
        wall, busy = ([[taken[k] for taken in turn] for turn in turns] for k in (0, 1))
        ratios = [statistics.median(a / b for a, b in times) for times in (wall, busy)]
        other, this = (1000 * statistics.median(x) for x in zip(*wall, strict=True))
        print(
            f"{name:26s} {other:10.2f} {this:10.2f} {ratios[0]:7.2f} {ratios[1]:7.2f}"
            f" {first[0]:11.2f}{first[1]:11.2f}",
            flush=True,
        )


class Version:
    """A process that runs one checkout."""

    def __init__(self, root: Path):
        command = [sys.executable, str(Path(__file__).resolve()), str(root), "--worker"]
        environment = {**os.environ, "PYTHONPATH": str(root)}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def ask(self, request: str) -> Any:
        """The answer to a request: the names of the rows, or the seconds of one call of a row."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        print(request, file=self.process.stdin, flush=True)
        return json.loads(self.process.stdout.readline())


def answer_requests() -> None:
    """In a worker: one line in, one line out, until the input ends."""
    rows = workload_rows()
    for line in sys.stdin:
        name = line.strip()
        if name == "names":
            print(json.dumps(list(rows)), flush=True)
            continue
        import jax

        begin, busy = time.perf_counter(), time.process_time()
        jax.block_until_ready(rows[name]())
        taken = time.perf_counter() - begin, time.process_time() - busy
        print(json.dumps(taken), flush=True)


def workload_rows() -> dict[str, Call]:
    """The rows, as calls of no arguments, from names that both versions have."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    import ewif_jax as ej
    from benchmarks import ours
    from benchmarks.workloads import constant_acceleration, irregular_and_late

    ej.prepare_cpu(1)
    runs, steps = 1024, 1000
    shared, own = (constant_acceleration(runs, steps, per_run=x) for x in (False, True))
    late = irregular_and_late(runs, steps // 4)
    tau = np.geomspace(1.0, 4.0, runs).astype(np.float32)
    model = ours.model()

    def late_row(estimator: ej.Estimator, params: dict) -> Call:
        return ours.batch_filter(estimator, params, late, per_run=True)

    rows: dict[str, Call] = {
        "L1a kalman": ours.kalman_filter(shared),
        "L1b kalman": ours.kalman_filter(own),
        "L2 ewif": late_row(ej.ewif(model, lambda p: p["tau"]), {"tau": tau}),
        "L2 al1 lag 8": late_row(ej.al1(model, 8), {"q": late.q}),
        "L2 drop_late(kalman)": late_row(ej.drop_late(ej.kalman(model)), {"q": late.q}),
        "L2 asd lag 8": late_row(ej.asd(model, 8), {"q": late.q}),
        "L2 replay lag 8": late_row(ej.replay(ej.kalman(model), 8), {"q": late.q}),
    }
    sensor = ej.models.position_sensor(lambda p: p["r"], dims=2)
    noisy = ej.models.constant_acceleration(sensors=sensor, q=lambda p: p["q"], dims=2)
    prior = ej.Gaussian(shared.prior_mean, shared.prior_cov)
    for name, estimator, params in (
        ("kalman", ej.kalman(noisy), {"q": jnp.float32(0.01), "r": jnp.float32(1.0)}),
        (
            "ewif",
            ej.ewif(noisy, lambda p: p["tau"]),
            {"tau": jnp.float32(1.0), "r": jnp.float32(1.0)},
        ),
    ):
        loss = ej.rmse_loss(
            estimator, ours.stream(shared), shared.truth[..., :2], prior=prior, t0=0.0
        )
        single = next(iter(params))
        rows[f"G1 {name} forward"] = _bound(jax.jit(loss), params)
        slope = jax.jit(
            lambda p, loss=loss, single=single: jax.jvp(
                lambda x: loss({**p, single: x}), (p[single],), (jnp.ones_like(p[single]),)
            )
        )
        rows[f"G1 {name} one slope"] = _bound(slope, params)
        rows[f"G1 {name} reverse"] = _bound(jax.jit(jax.value_and_grad(loss)), params)
    one = jax.tree.map(
        lambda x: x[0] if np.ndim(x) > 2 else x, ej.stream(shared.time, shared.value[0])
    )
    for name, estimator, params in (
        ("kalman", ej.kalman(model), {"q": 0.01}),
        ("ewif", ej.ewif(model, lambda p: p["tau"]), {"tau": 1.0}),
        ("al1", ej.al1(model, 8), {"q": 0.01}),
    ):
        rows[f"single run {name}"] = lambda e=estimator, p=params: ej.run(
            e, p, one, prior=prior, t0=0.0
        )
    return rows


def _bound(call: Callable[[Any], Any], params: Any) -> Call:
    return lambda: call(params)


if __name__ == "__main__":
    main()
