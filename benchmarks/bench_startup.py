"""Time imports and first results (C1): ``python -m benchmarks.bench_startup``.

Each figure comes from a fresh Python process: the seconds from the call of `run` to its first
result (checks, trace, compile, run) for a constant-velocity model and 50 measurements, and the
seconds of processor time in them, which other work on the machine changes less.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from statistics import median

from benchmarks.timing import environment

OUTPUT = Path(__file__).parent / "results" / "startup.json"
ESTIMATORS = {
    "kalman": "ej.kalman(model)",
    "information": "ej.information(model)",
    "square_root": "ej.square_root(model)",
    "fading": "ej.fading(model, 1.1)",
    "ewif": "ej.ewif(model, 1.0)",
    "limited_memory": "ej.limited_memory(model, 1.0, 16)",
    "extended": "ej.extended(model)",
    "unscented": "ej.unscented(model)",
    "ensemble": "ej.ensemble(model, 100)",
    "bootstrap": "ej.bootstrap(model, 1000)",
    "a1": "ej.a1(model)",
    "b1": "ej.b1(model)",
    "al1": "ej.al1(model, 10)",
    "bl1": "ej.bl1(model, 10)",
    "asd": "ej.asd(model, 10)",
    "replay": "ej.replay(ej.kalman(model), 10)",
    "drop_late": "ej.drop_late(ej.ewif(model, 1.0))",
    "selective": "ej.selective(ej.ewif(model, 1.0), 3.0)",
    "rts_reference": "ej.rts_reference(model, 10)",
    "fixed_lag": "ej.fixed_lag(model, 10)",
    "enkf1": "ej.enkf1(model, 100, 10)",
    "enkf2": "ej.enkf2(model, 100, 10)",
    "pf_retrodict": "ej.pf_retrodict(model, 1000)",
    "pf_extended": "ej.pf_extended(model, 1000, 10)",
    "pf_fixed_point": "ej.pf_fixed_point(model, 1000, 10)",
    "pf_fixed_point uks": "ej.pf_fixed_point(model, 1000, 10, smoother='uks')",
    "pf_fixed_point ps": "ej.pf_fixed_point(model, 1000, 10, smoother='ps')",
}
IMPORT = """
import time
import jax
start, cpu = time.perf_counter(), time.process_time()
import ewif_jax
print(time.perf_counter() - start, time.process_time() - cpu)
"""
FIRST = """
import time
import jax
import numpy as np
import ewif_jax as ej
sensor = ej.models.position_sensor(1.0, dims=2)
model = ej.models.constant_velocity(sensors=sensor, q=1.0, dims=2)
stream = ej.stream(np.arange(50.0, dtype=np.float32), np.zeros((50, 2), np.float32))
prior = ej.Gaussian(np.zeros(4, np.float32), np.eye(4, dtype=np.float32))
jax.block_until_ready(jax.numpy.zeros(3) + 1)
key = jax.random.key(0)
estimator = {estimator}
start, cpu = time.perf_counter(), time.process_time()
jax.block_until_ready(ej.run(estimator, None, stream, prior=prior, t0=0.0, key=key))
print(time.perf_counter() - start, time.process_time() - cpu)
"""


def main() -> None:
    """Time every estimator and the import, print a table and write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=3, help="processes for each figure")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    parser.add_argument("--only", nargs="*", default=list(ESTIMATORS), choices=ESTIMATORS)
    options = parser.parse_args()
    scripts = {"import ewif_jax, over import jax": IMPORT}
    scripts |= {name: FIRST.format(estimator=ESTIMATORS[name]) for name in options.only}
    seconds, processor = {}, {}
    for name, script in scripts.items():
        pairs = [_seconds(script) for _ in range(options.repeat)]
        seconds[name], processor[name] = (sorted(x) for x in zip(*pairs, strict=True))
        wall, cpu = (median(x[name]) for x in (seconds, processor))
        print(f"{name:34} {wall:6.2f} s {cpu:6.2f} s processor", flush=True)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    about = {"environment": environment(), "seconds": seconds, "processor": processor}
    options.output.write_text(json.dumps(about, indent=2) + "\n")


def _seconds(script: str) -> tuple[float, float]:
    """By the clock and of the processor, as the script prints them."""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    wall, cpu = map(float, done.stdout.split())
    return wall, cpu


if __name__ == "__main__":
    main()
