"""Time particle filters on N1 and late measurements: ``python -m benchmarks.bench_particles``.

N1: 10,000 particles, 5 states (coordinated turn), two bearings a step, 100 steps, float32 in JAX
and float64 in ``particles`` (which has no other). All resample systematically below half of the
effective sample size and return the filtered means; these must agree. Then one late measurement
after an in-sequence one, for every method of ours. Read the ratios within one table.
"""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import ewif_jax as ej
from benchmarks.timing import measure, report
from ewif_jax.estimators.bootstrap import bootstrap
from ewif_jax.models import Model, wrap_angle
from ewif_jax.models.coordinated_turn import coordinated_turn
from ewif_jax.models.sensors import Sensor
from ewif_jax.oosm.pf_extended import pf_extended
from ewif_jax.oosm.pf_fixed_point import pf_fixed_point
from ewif_jax.oosm.pf_retrodict import pf_retrodict

OUTPUT = Path(__file__).parent / "results" / "particles.json"
STATIONS = np.array([[-200.0, 0.0], [200.0, 0.0]])
SIGMA, Q, Q_TURN = 0.05, 10.0, 1e-3
MEAN = np.array([-500.0, 500.0, 0.0, 55.0, -0.1])
SD = np.array([25.0, 25.0, 5.0, 5.0, 0.02])


class N1(NamedTuple):
    """The model, its prior, and bearings (T, 2) at times 1..T of one simulated track."""

    model: Model
    prior: ej.Gaussian
    values: np.ndarray


def workload(steps: int, seed: int = 0) -> N1:
    """One track of `steps` seconds."""
    sensor = Sensor(_bearings, lambda p, t: SIGMA**2 * jnp.eye(2), (True, True))
    model = coordinated_turn(sensors=sensor, q=Q, q_turn=Q_TURN)
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(np.asarray(model.process_cov(None, 0.0, 1.0)))
    x, values = MEAN, []
    for _ in range(steps):
        x = np.asarray(model.transition(None, jnp.asarray(x), 0.0, 1.0)) + root @ rng.normal(size=5)
        values.append(np.asarray(_bearings(None, x, 0.0)) + SIGMA * rng.normal(size=2))
    prior = ej.Gaussian(MEAN.astype(np.float32), np.diag(SD**2).astype(np.float32))
    return N1(model, prior, np.array(values, np.float32))


def _bearings(params: object, x: jax.Array, t: object) -> jax.Array:
    return jnp.stack([jnp.arctan2(x[1] - y, x[0] - east) for east, y in STATIONS])


def ours(work: N1, particles: int) -> Callable[[], jax.Array]:
    """`bootstrap`."""
    data = ej.stream(np.arange(1.0, len(work.values) + 1, dtype=np.float32), work.values)
    method, key = bootstrap(work.model, particles), jax.random.key(0)
    filtered = jax.jit(
        lambda data: ej.run(method, None, data, prior=work.prior, t0=0.0, key=key).mean
    )
    return partial(filtered, data)


def deviations(work: N1, particles: int) -> np.ndarray:
    """Standard deviations (T, 5) that `bootstrap` reports."""
    data = ej.stream(np.arange(1.0, len(work.values) + 1, dtype=np.float32), work.values)
    method, key = bootstrap(work.model, particles), jax.random.key(1)
    trace = ej.run(method, None, data, prior=work.prior, t0=0.0, key=key)
    return np.sqrt(np.diagonal(trace.cov, axis1=1, axis2=2))


def cuthbert_filter(work: N1, particles: int) -> Callable[[], jax.Array]:
    """cuthbert's particle filter, sequential in time."""
    import cuthbert
    from cuthbert.smc import particle_filter
    from cuthbertlib.resampling import systematic
    from cuthbertlib.resampling.adaptive import ess_decorator

    zero, one = jnp.float32(0.0), jnp.float32(1.0)
    root = jnp.linalg.cholesky(work.model.process_cov(None, zero, one)).astype(jnp.float32)
    sd = jnp.asarray(SD, jnp.float32)

    def draw(key: jax.Array) -> jax.Array:
        return work.prior.mean + sd * jax.random.normal(key, (5,))

    def propagate(key: jax.Array, x: jax.Array, z: jax.Array) -> jax.Array:
        moved = work.model.transition(None, x, zero, one)
        return moved + root @ jax.random.normal(key, (5,))

    def log_potential(before: jax.Array, x: jax.Array, z: jax.Array) -> jax.Array:
        return -0.5 * jnp.sum(jnp.square(wrap_angle(z - _bearings(None, x, zero)) / SIGMA))

    built = particle_filter.build_filter(
        draw, propagate, log_potential, particles, ess_decorator(systematic.resampling, 0.5)
    )

    @jax.jit
    def filtered(values: jax.Array) -> jax.Array:
        first, rest = jax.random.split(jax.random.key(0))
        states = cuthbert.filter(built, values, built.init_prepare(key=first), key=rest)
        weights = jax.nn.softmax(states.log_weights, axis=1)
        return jnp.einsum("tn,tni->ti", weights, states.particles)[1:]

    return partial(filtered, jnp.asarray(work.values))


def particles_filter(work: N1, particles: int) -> Callable[[], np.ndarray]:
    """The library `particles`: NumPy, one filter at a time."""
    from particles import SMC
    from particles import distributions as dists
    from particles import state_space_models as ssm
    from particles.collectors import Moments

    cov = np.asarray(work.model.process_cov(None, 0.0, 1.0), float)

    def move(x: np.ndarray) -> np.ndarray:
        half = x[:, 4] / 2
        chord = np.sinc(half / np.pi)
        c, s = np.cos(half), np.sin(half)
        east, north = c * x[:, 2] - s * x[:, 3], s * x[:, 2] + c * x[:, 3]
        return np.stack(
            [
                x[:, 0] + chord * east,
                x[:, 1] + chord * north,
                c * east - s * north,
                s * east + c * north,
                x[:, 4],
            ],
            1,
        )

    class Bearings(dists.ProbDist):
        """Wrapped Gaussian bearings of the particles."""

        dim = 2

        def __init__(self, x: np.ndarray) -> None:
            self.seen = np.stack([np.arctan2(x[:, 1] - y, x[:, 0] - e) for e, y in STATIONS], 1)

        def logpdf(self, z: np.ndarray) -> np.ndarray:
            off = np.mod(z - self.seen + np.pi, 2 * np.pi) - np.pi
            return -0.5 * np.sum((off / SIGMA) ** 2, 1)

    class Turn(ssm.StateSpaceModel):
        """N1 in the words of the library."""

        def PX0(self) -> dists.ProbDist:
            start = move(MEAN[None])[0]
            jacobian = (move(MEAN + 1e-4 * np.eye(5)) - start) / 1e-4
            return dists.MvNormal(loc=start, cov=jacobian.T @ np.diag(SD**2) @ jacobian + cov)

        def PX(self, t: int, xp: np.ndarray) -> dists.ProbDist:
            return dists.MvNormal(loc=move(xp), cov=cov)

        def PY(self, t: int, xp: np.ndarray, x: np.ndarray) -> dists.ProbDist:
            return Bearings(x)

    def filtered() -> np.ndarray:
        np.random.seed(0)
        model = ssm.Bootstrap(ssm=Turn(), data=list(np.asarray(work.values, float)))
        run = SMC(fk=model, N=particles, resampling="systematic", ESSrmin=0.5, collect=[Moments()])
        run.run()
        return np.array([moment["mean"] for moment in run.summaries.moments])

    return filtered


def late(work: N1, particles: int) -> dict[str, tuple[Callable[[], object], Callable[[], object]]]:
    """For each method one step in sequence, and one with a measurement that is 2.5 s late."""
    methods = {
        "bootstrap": bootstrap(work.model, particles),
        "pf_retrodict": pf_retrodict(work.model, particles),
        "pf_extended": pf_extended(work.model, particles, 5),
        "pf_fixed_point eks": pf_fixed_point(work.model, particles, 5, "eks"),
        "pf_fixed_point uks": pf_fixed_point(work.model, particles, 5, "uks"),
        "pf_fixed_point ps": pf_fixed_point(work.model, particles, 5, "ps"),
    }
    data = ej.stream(np.arange(1.0, 9.0, dtype=np.float32), work.values[:8])
    rows = {}
    for name, method in methods.items():
        step = jax.jit(lambda state, z, method=method: ej.step(method, None, state, z))
        state = method.init(None, work.prior, 0.0, jax.random.key(0))
        for k in range(7):
            state, _ = step(state, jax.tree.map(lambda x, k=k: x[k], data))
        now = jax.tree.map(lambda x: x[7], data)
        old = now._replace(time=state.time - 2.5, value=jnp.asarray(work.values[4]))
        rows[name] = partial(step, state, now), partial(step, state, old)
    return rows


def main() -> None:
    """Time the filters, check that they agree, print the table and write the JSON."""
    options = _options()
    ej.prepare_cpu(1)
    work = workload(options.steps)
    filters = {"ewif_jax": ours, "cuthbert": cuthbert_filter, "particles": particles_filter}
    results, means = [], {}
    names = ("ewif_jax", *options.peers)
    calls = {name: filters[name](work, options.particles) for name in names}
    for name, times in measure(calls, options.repeat, options.budget).items():
        means[name] = np.asarray(calls[name]())
        results.append({"workload": "N1", "name": name, "run_steps": options.steps} | times)
    for row in results:
        apart = (means[row["name"]] - means["ewif_jax"]) / deviations(work, options.particles)
        row["apart_in_standard_deviations"] = float(np.sqrt(np.mean(apart**2)))
        assert row["apart_in_standard_deviations"] < 0.3, row
    pairs = late(work, options.particles)
    for k, label in enumerate(("in sequence", "late")):
        calls = {name: pair[k] for name, pair in pairs.items()}
        for name, times in measure(calls, 3 * options.repeat, options.budget).items():
            results.append({"workload": label, "name": name, "run_steps": 1} | times)
    report(results, options.output, references=("cuthbert", "particles", "bootstrap"))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--particles", type=int, default=10_000)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--repeat", type=int, default=7, help="later calls to time")
    parser.add_argument("--budget", type=float, default=10.0, help="seconds for them, each row")
    peers = ["cuthbert", "particles"]
    parser.add_argument("--peers", nargs="*", default=peers, choices=peers)
    parser.add_argument("--output", type=Path, default=OUTPUT, help="JSON file")
    return parser.parse_args()


if __name__ == "__main__":
    main()
