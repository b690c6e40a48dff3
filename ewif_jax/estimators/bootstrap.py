"""The bootstrap particle filter."""

from jax import Array

from ewif_jax.kernels.resampling import Resampling
from ewif_jax.models import Model
from ewif_jax.recipe import from_recipe
from ewif_jax.recursions import particles as form
from ewif_jax.recursions import weighing
from ewif_jax.recursions.contract import Recursion, estimator_from
from ewif_jax.recursions.particles import ParticleState
from ewif_jax.types import Estimator, Gaussian, Info, Measurement, Params


@from_recipe
def bootstrap(
    model: Model,
    particles: int,
    resampling: Resampling = "systematic",
    ess_threshold: float = 0.5,
) -> Estimator:
    r"""The particle filter that moves particles by the model and weighs them by the measurement.

    .. math::
        x_k^i = f(x_{k-1}^i) + v^i, \quad v^i \sim N(0, Q), \qquad
        w_k^i \propto w_{k-1}^i\, p(z_k | x_k^i), \qquad
        \hat x = \sum_i w^i x^i, \quad P = \sum_i w^i (x^i - \hat x)(x^i - \hat x)'

    sampling importance resampling (Gordon, Salmond & Smith 1993; (3)-(7) of Orguner & Gustafsson
    with the motion as proposal; (87), (90)-(92) of Pornsarayouth & Yamakita in sequence). Weights
    are logarithms throughout. The log likelihood of a measurement is the logarithm of the mean
    density, so the sum over a stream is the logarithm of an unbiased estimate of the likelihood.

    Args:
        model: linear or not, with Gaussian noise. Q and the prior's covariance may be singular or
            zero; R must be positive definite (else every measurement is `REJECTED`).
        particles: N >= 2.
        resampling: "systematic" (one random number) or "stratified" (one per particle).
        ess_threshold: the filter resamples before it moves on when fewer than this share of the
            particles count (effective sample size 1 / sum w^2). 0: never, 1: always but for equal
            weights.

    A late measurement is not used (`TOO_LATE`). One whose density is zero or not a number for every
    particle is `REJECTED` and changes nothing; particles for which alone this holds get weight
    zero. `init` needs a key, which travels in the state.

    Where the process noise is tiny next to the spread of the particles, resampled copies stay
    together: after a few resamplings all particles descend from a few, the cloud no longer covers
    the posterior, and neither `Status` nor the covariance shows it. Take more particles, or more
    process noise.

    Gradients: particles are differentiated along their random numbers, and resampling keeps the
    derivative of the weights (w / stop_gradient(w), Scibior & Wood 2021), so that the derivative
    of the likelihood estimate (exp of the summed log likelihood) is unbiased, and that of the log
    likelihood has a bias of order 1 / N. Its variance grows with a power of the number of steps,
    because ancestral lines merge: from 1.4 to 4 for random walks of 6 to 48 steps that resample at
    every one, more for longer ones, and depending on the data and the parameter. It is not the
    finite difference of a run with equal random numbers, which jumps where a resampling changes.
    With ess_threshold=0 both are equal.

    Reduces to: `kalman` on a linear model as N grows, with errors of order 1 / sqrt(N).

    Raises:
        ValueError: fewer than 2 particles; an unknown scheme; `init` without a key or a prior.

    Deviations: resampling waits until the filter moves on, so that estimates do not carry its
        noise.
    """
    kind = form.cloud(model, particles, resampling, ess_threshold)

    def start(params: Params, prior: Gaussian, t0: Array, key: Array) -> ParticleState:
        del params
        return form.drawn_particles(kind, prior, t0, key)

    def measure(
        params: Params, state: ParticleState, measurement: Measurement
    ) -> tuple[ParticleState, Info]:
        seen = weighing.look_of_cloud(
            model, params, state.particles, state.log_weights, measurement
        )
        log_weights, info = weighing.weigh(state, seen, measurement)
        return state._replace(log_weights=log_weights), info

    recursion = Recursion(
        "bootstrap", start, form.mover(kind), measure, form.estimator_of_cloud(model), model=model
    )
    return estimator_from(recursion._replace(draws=True, estimated=("particles",)))
