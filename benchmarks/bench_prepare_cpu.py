"""What `prepare_cpu` does for JAX code that has nothing to do with this package: a Kalman filter
written by hand as a `lax.scan`, alone, in a batch, and its gradient.

Settings of XLA belong to a process, so each measurement is a process of its own; with and without
take turns, and what counts is the median of the rounds.

Run from the top folder: `python -m benchmarks.bench_prepare_cpu`.
"""

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version

SEED = 0
STEPS, RUNS, STEPS_OF_RUNS = 20_000, 64, 1_000
ROUNDS, REPEATS = 3, 5
PREPARED = "prepared"


def programs() -> dict[str, Callable[[], object]]:
    """The filter as a user of JAX writes it, on data of a fixed seed."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    F = jnp.eye(4) + jnp.eye(4, k=2)
    H = jnp.eye(2, 4)
    G = jnp.concatenate([0.5 * jnp.eye(2), jnp.eye(2)])

    def by_solve(S, HP):
        return jnp.linalg.solve(S, HP).T

    def by_hand(S, HP):
        adjugate = jnp.array([[S[1, 1], -S[0, 1]], [-S[1, 0], S[0, 0]]])
        return HP.T @ adjugate / (S[0, 0] * S[1, 1] - S[0, 1] * S[1, 0])

    def mean_square(q, values, gain):
        def step(carry, z):
            x, P = carry
            x, P = F @ x, F @ P @ F.T + q * G @ G.T
            S = H @ P @ H.T + jnp.eye(2)
            K = gain(S, H @ P)
            nu = z - H @ x
            return (x + K @ nu, P - K @ S @ K.T), nu @ nu

        return jax.lax.scan(step, (jnp.zeros(4), 10 * jnp.eye(4)), values)[1].mean()

    rng = np.random.default_rng(SEED)
    one = jnp.asarray(rng.normal(size=(STEPS, 2)).cumsum(0), jnp.float32)
    many = jnp.asarray(rng.normal(size=(RUNS, STEPS_OF_RUNS, 2)).cumsum(1), jnp.float32)
    found = {}
    for how, gain in (("2 x 2 inverse by hand", by_hand), ("`jnp.linalg.solve`", by_solve)):
        alone = partial(mean_square, gain=gain)
        found |= {
            f"one series, {how}": partial(jax.jit(alone), 0.1, one),
            f"its gradient in q, {how}": partial(jax.jit(jax.grad(alone)), 0.1, one),
            f"vmap over {RUNS} runs, {how}": partial(
                jax.jit(jax.vmap(alone, (None, 0))), 0.1, many
            ),
        }
    return found


def measured(prepared: bool) -> dict[str, list[float]]:
    """Seconds of the first call of each program, and the median of later ones, in this process."""
    if prepared:
        import ewif_jax as ej

        ej.prepare_cpu()
    import jax

    found = {}
    for name, program in programs().items():
        took = []
        for _ in range(1 + REPEATS):
            start = time.perf_counter()
            jax.block_until_ready(program())
            took.append(time.perf_counter() - start)
        found[name] = [took[0], statistics.median(took[1:])]
    return found


def in_its_own_process(prepared: bool) -> dict[str, list[float]]:
    """What `measured` finds in a new process."""
    command = [
        sys.executable,
        "-m",
        "benchmarks.bench_prepare_cpu",
        PREPARED if prepared else "plain",
    ]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def three(x: float) -> str:
    """A number to three digits."""
    return f"{float(f'{x:.3g}'):,g}"


def main() -> None:
    """Prints the table of `docs/prepare-cpu.md`."""
    rounds = [(in_its_own_process(False), in_its_own_process(True)) for _ in range(ROUNDS)]
    print("| program | before, ms | after, ms | times as fast | first call before, after, s |")
    print("|---|---|---|---|---|")
    for name in rounds[0][0]:
        first, later = ([[kind[name][k] for kind in pair] for pair in rounds] for k in (0, 1))
        before, after = (1e3 * statistics.median(pair[i] for pair in later) for i in (0, 1))
        gain = statistics.median(pair[0] / pair[1] for pair in later)
        begun = [statistics.median(pair[i] for pair in first) for i in (0, 1)]
        cells = name, three(before), three(after), f"{gain:.1f}", ", ".join(map(three, begun))
        print("| " + " | ".join(cells) + " |")
    print(
        f"\n{STEPS:,} steps of one series, {STEPS_OF_RUNS:,} of each of {RUNS} runs; seed {SEED},"
        f" float32, median of {ROUNDS} rounds of {REPEATS} calls;"
        f" jax {version('jax')}, jaxlib {version('jaxlib')}, ewif_jax {version('ewif_jax')}"
    )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        print(json.dumps(measured(sys.argv[1] == PREPARED)))
    else:
        main()
