"""Ensembles: members that stand for a distribution, moved and updated one by one."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ewif_jax import checks
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.kernels import cholesky, gaussian, symmetric
from ewif_jax.kernels.trees import choose
from ewif_jax.models.angles import Angles, centre_of, wrapped_state
from ewif_jax.models.model import Model
from ewif_jax.recursions.innovations import are_finite
from ewif_jax.recursions.sigma_points import view
from ewif_jax.types import Gaussian, Measurement, Numbers, Params


class EnsembleState(NamedTuple):
    """time (), members (n, N), key: of the process noise to come, sight: key of the measurement
    noise at this time."""

    time: Array
    members: Array
    key: Array
    sight: Array


class EnsembleLook(NamedTuple):
    """What an ensemble makes of a measurement: deviations (m, N) of what its members predict from
    their mean, the noise root G (m, m) with R = G G', the innovation, and mask (m,) of what is
    used: nothing if innovation or covariance are not finite (all_finite () is False then)."""

    deviations: Array
    noise: Array
    innovation: gaussian.Innovation
    mask: Array
    all_finite: Array


def drawn(prior: Gaussian, t0: Array, key: Array, count: int) -> EnsembleState:
    """`count` members drawn from the prior."""
    own, path, sight = jax.random.split(key, 3)
    members = prior.mean[:, None] + noise(own, cholesky.factor(prior.cov).lower, count)
    return EnsembleState(t0, members, path, sight)


def noise(key: Array, root: Array, count: int) -> Array:
    """`count` draws (n, count) with covariance root root', moved so that their mean is zero.

    Drawn from float32 whatever the dtype, so that single and double precision see the same noise:
    uniform numbers, which are exact, so that how a program is compiled makes no difference.
    """
    above = np.nextafter(np.float32(-1), np.float32(0))
    uniform = jax.random.uniform(key, (root.shape[1], count), jnp.float32, above, 1)
    # The inverse of the normal distribution function from uniform numbers in (-1, 1); -1 itself
    # would be minus infinity.
    drawn = np.sqrt(2, dtype=root.dtype) * lax.erf_inv(uniform.astype(root.dtype))
    # Without their mean: a sample mean that wanders by sigma / sqrt(N) in every step would be an
    # error of the estimate that the ensemble's spread does not know.
    return matmul(root, drawn - jnp.mean(drawn, 1, keepdims=True))


def process_noise(
    model: Model, params: Params, key: Array, members: Array, t0: Array, t1: Array
) -> Array:
    """Draws (n, N) of the process noise of an interval, one for each member."""
    Q = jnp.asarray(model.process_cov(params, t0, t1), members.dtype)
    checks.shape("Q", Q, (members.shape[0],) * 2)
    return noise(key, cholesky.factor(Q).lower, members.shape[1])


def carried_members(model: Model, params: Params, members: Array, t0: Array, t1: Array) -> Array:
    """The members (n, N) at t1, without process noise."""

    def move(x: Array) -> Array:
        return jnp.asarray(model.transition(params, x, t0, t1), x.dtype)

    return jax.vmap(move, in_axes=1, out_axes=1)(members)


def moved_members(
    model: Model, params: Params, state: EnsembleState, time: Array
) -> tuple[EnsembleState, Array]:
    """The state at a time not before its own, and the process noise (n, N) it met.

    Keys are used up by moving only, never by what is measured in between: filters that start from
    one key and move at the same times meet the same noise.
    """
    key, motion, sight = jax.random.split(state.key, 3)
    met = process_noise(model, params, motion, state.members, state.time, time)
    members = carried_members(model, params, state.members, state.time, time) + met
    return choose(time > state.time, EnsembleState(time, members, key, sight), state), met


def sight_keys(sight: Array, sensor: Array) -> tuple[Array, Array]:
    """The key of a measurement of this sensor, and the one for the next measurement. Sensors get
    different noise also in filters that share everything else."""
    return jax.random.fold_in(sight, sensor + 1), jax.random.fold_in(sight, 0)


def back_key(sight: Array) -> Array:
    """The key of process noise that is drawn to look back; no sensor has this number."""
    return jax.random.fold_in(sight, 2**32 - 1)


def look_of_ensemble(
    model: Model, params: Params, members: Array, there: Array, measurement: Measurement
) -> EnsembleLook:
    """The measurement as predicted by the members `there` (n, N) at its time; `innovation.cross`
    relates it to `members`."""
    sensor, mask = measurement.sensor, measurement.mask
    middle = mean_of(there, model.state_angle)
    see, R = view(model, params, sensor, measurement.time, middle)
    origin = see(middle)
    checks.shape("measurement.value", measurement.value, origin.shape)
    checks.shape("R", R, origin.shape * 2)

    def offset(x: Array) -> Array:
        return model.residual(see(x), origin, sensor)

    offsets = jax.vmap(offset, in_axes=1, out_axes=1)(there)
    shift = mean_of(offsets)
    # All members or none: a mean over some of them would be another ensemble's.
    every_offset = jnp.all(jnp.isfinite(offsets) | ~mask[:, None])
    deviations = jnp.where(mask[:, None] & every_offset, offsets - shift[:, None], 0)
    # After an exact measurement members differ by rounding only, which would be weighed like
    # knowledge by the next one: a component without noise would divide by it.
    apart = jnp.max(jnp.abs(deviations), 1) > gaussian.rounding_of(origin)
    deviations = jnp.where(apart[:, None], deviations, 0)
    difference = model.residual(measurement.value, origin + shift, sensor)
    cov = sample_spread(deviations) + R
    all_finite = every_offset & are_finite(difference, cov, mask)
    mask = mask & all_finite
    innovation = gaussian.innovate(
        difference, sample_cov(deviations, members, model.state_angle), cov, mask
    )
    root = cholesky.factor(gaussian.mask_cov(R, mask)).lower
    return EnsembleLook(jnp.where(all_finite, deviations, 0), root, innovation, mask, all_finite)


def perturbed(members: Array, looked: EnsembleLook, key: Array) -> Array:
    """Each member moved by the gain times its own innovation, nu - (z_i - mean z) - w_i.

    Only nu has been wrapped. Wrapped one by one, the innovations of angles far from the prediction
    would fall on both sides of the cut, and members would part that the gain takes for close.
    """
    drawn = noise(key, looked.noise, members.shape[1])
    own = looked.innovation.value[:, None] - looked.deviations - drawn
    own = jnp.where(looked.mask[:, None], own, 0)
    return members + matmul(gaussian.gain(looked.innovation), own)


def transformed_members(members: Array, looked: EnsembleLook) -> Array:
    r"""The mean moved by the gain times the innovation, the deviations by
    :math:`\bar K = P_{xz} L'^{-1} (L + G)^{-1}` with :math:`P_{zz} = L L',\; R = G G'`."""
    innovation = looked.innovation
    # For one component deviations shrink by G / L, the root of R / (P_hh + R): what a Kalman filter
    # leaves of the variance (Whitaker & Hamill 2002), without a draw of noise.
    lower = innovation.factor.lower + looked.noise
    diagonal = jnp.diag(lower)
    kept = diagonal > 0
    reciprocal = jnp.where(kept, 1 / jnp.where(kept, diagonal, 1), 0)
    both = cholesky.Factor(lower, reciprocal, jnp.all(kept))
    white = cholesky.forward(innovation.factor, innovation.cross)
    gain = cholesky.backward(both, white).T
    step = matvec(gaussian.gain(innovation), innovation.value)
    return members + step[:, None] - matmul(gain, looked.deviations)


def mean_of(members: Array, angle: Angles = None) -> Array:
    """The sample mean (n,) of members (n, N), that of angles in (-pi, pi]."""
    # About one of them: a sum of large numbers would round away the spread of close ones.
    centre = centre_of(angle, members)
    away = wrapped_state(angle, members - centre[:, None])
    return wrapped_state(angle, centre + jnp.mean(away, 1))


def deviations_of(members: Array, angle: Angles = None) -> Array:
    """The members (n, N) less their mean."""
    return wrapped_state(angle, members - mean_of(members, angle)[:, None])


def sample_cov(a: Array, b: Array, angle: Angles = None) -> Array:
    """The sample covariance (p, q) of a (p, N) with b (q, N), where a has mean zero; of b these are
    angles."""
    centred = deviations_of(b, angle)
    return jnp.matmul(a, centred.T, precision=jax.lax.Precision.HIGHEST) / (a.shape[1] - 1)


def sample_spread(deviations: Array) -> Array:
    """The sample covariance (p, p) of deviations (p, N) from a mean, symmetric to the last bit."""
    return symmetric.unpack(symmetric.pack(sample_cov(deviations, deviations)))


def sample_moments(members: Array, angle: Angles = None) -> Gaussian:
    """Sample mean (n,) and covariance (n, n) of members (n, N)."""
    return Gaussian(mean_of(members, angle), sample_spread(deviations_of(members, angle)))


def fuse_ensembles(ensembles: Numbers) -> Array:
    r"""One ensemble of several that estimate the same state at the same time.

    .. math::
        x_i^{12} = x_i^1 + P_{x^1\delta} P_{\delta\delta}^{-1} (x_i^2 - x_i^1), \quad
        \delta = e^1 - e^2 \quad (34)-(38)

    Pornsarayouth & Yamakita, applied to pairs, pairs of pairs and so on. The cross-covariance of
    the estimates is read off the members, so these have to share their random numbers: run the
    filters (`ensemble`, `enkf1`, `enkf2`) from the same key, moving at the same times. Measurement
    noise is then drawn apart for each sensor, prior and process noise together.

    Args:
        ensembles: at least one array (n, N): the field `members` of each state.

    Returns:
        The fused members (n, N).

    Reduces to: the ensemble itself where all are equal; for linear models and many members the
        best linear combination of correlated estimates (Bar-Shalom & Campo 1986), two at a time.

    Raises:
        ValueError: no ensemble, or ensembles of different shapes.
    """
    level = [jnp.asarray(x) for x in ensembles]
    checks.require(len(level) > 0, "ensembles", "at least one ensemble", "none")
    for k, x in enumerate(level):
        checks.shape(f"ensembles[{k}]", x, ("n", "N"))
        checks.shape(f"ensembles[{k}]", x, level[0].shape)
    while len(level) > 1:
        pairs = [_fused_pair(a, b) for a, b in zip(level[::2], level[1::2], strict=False)]
        level = pairs + level[2 * len(pairs) :]
    return level[0]


def uncorrelated(members: Array, d: Array, angle: Angles = None) -> Array:
    """The members (n, N) less their regression on d (n, N): x_i - P_xd P_dd^-1 d_i."""
    deviations = d - mean_of(d)[:, None]
    weights = cholesky.solved(sample_spread(deviations), sample_cov(deviations, members, angle))
    return members - matmul(weights.T, d)


def _fused_pair(first: Array, second: Array) -> Array:
    return uncorrelated(first, first - second)
