"""Time imports and first results (C1): ``python -m benchmarks.bench_startup``.

Each figure comes from a fresh Python process: the seconds from the call of `run` to its first
result (checks, trace, compile, run) for a constant-velocity model and 50 measurements.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

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
    "al1": "ej.al1(model, 10)",
    "asd": "ej.asd(model, 10)",
    "replay": "ej.replay(ej.kalman(model), 10)",
    "unscented": "ej.unscented(model)",
    "ensemble": "ej.ensemble(model, 100)",
    "enkf2": "ej.enkf2(model, 100, 10)",
    "bootstrap": "ej.bootstrap(model, 1000)",
    "pf_fixed_point": "ej.pf_fixed_point(model, 1000, 10)",
}
IMPORT = """
import time
a = time.perf_counter()
import jax
b = time.perf_counter()
import ewif_jax
print(time.perf_counter() - b)
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
start = time.perf_counter()
jax.block_until_ready(ej.run(estimator, None, stream, prior=prior, t0=0.0, key=key))
print(time.perf_counter() - start)
"""


def main() -> None:
    """Time every estimator and the import, print a table and write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeat", type=int, default=3, help="processes for each figure")
    parser.add_argument("--output", type=Path, default=OUTPUT)
    options = parser.parse_args()
    scripts = {"import ewif_jax, over import jax": IMPORT}
    scripts |= {name: FIRST.format(estimator=code) for name, code in ESTIMATORS.items()}
    seconds = {}
    for name, script in scripts.items():
        seconds[name] = sorted(_seconds(script) for _ in range(options.repeat))
        print(f"{name:34} {seconds[name][options.repeat // 2]:6.2f} s", flush=True)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    about = {"environment": environment(), "seconds": seconds}
    options.output.write_text(json.dumps(about, indent=2) + "\n")


def _seconds(script: str) -> float:
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    return float(done.stdout)


if __name__ == "__main__":
    main()
