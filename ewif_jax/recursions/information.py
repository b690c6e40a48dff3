"""Information form: what is known, as equations about the distance from a reference mean.

The state is x = mean + d, and equation k says T_k d = targets_k with an error of variance
variances_k: the information matrix is T' diag(1 / variances) T with a unit upper triangular T
(`kernels.equations`). A direction about which nothing is known has an infinite variance and needs
no special case; a precise and a vague one live side by side in float32; nothing that was known is
ever unknown again. The targets keep what re-centring leaves over, rounding of the mean included:
far from the origin that is more than what one measurement changes.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.batched import largest
from ewif_jax.fast.small import matmul, matvec
from ewif_jax.fast.sparse import dense
from ewif_jax.kernels import absorbing, cholesky, equations, gaussian, remainders, symmetric
from ewif_jax.kernels.growth import Fade, bounded_reciprocal, grown
from ewif_jax.kernels.orthogonal import spread
from ewif_jax.kernels.trees import choose
from ewif_jax.models import Model
from ewif_jax.models.linearise import affine_flow, size
from ewif_jax.recursions.sighting import Sight, noise_of, sight, still_at_once, summed
from ewif_jax.types import Gaussian, Info, Measurement, Numbers, Params, Status


class InformationState(NamedTuple):
    """time (), mean (n,): the reference, variances (n,), rows (n (n - 1) / 2,), targets (n,): the
    equations."""

    time: Array
    mean: Array
    variances: Array
    rows: Array
    targets: Array

    @property
    def matrix(self) -> Array:
        """The upper triangle of the information matrix, row by row."""
        T = equations.upper(self.rows)
        return symmetric.pack(T.T @ (T / self.variances[:, None]))


def start(model: Model, params: Params, prior: Gaussian | None, t0: Numbers) -> InformationState:
    """The state that knows the prior, or nothing."""
    checks.prior(prior)
    if prior is None:
        t0 = jnp.asarray(t0)
        t0 = t0 if jnp.issubdtype(t0.dtype, jnp.floating) else t0.astype(float)
        nothing = jnp.zeros(size(model, params, t0), t0.dtype)
        return InformationState(t0, nothing, *_unknown(nothing))
    checks.psd("prior.cov", prior.cov, definite=True)
    mean = jnp.asarray(prior.mean)
    variances, rows = equations.of_covariance(jnp.asarray(prior.cov, mean.dtype))
    return InformationState(
        jnp.asarray(t0, mean.dtype), mean, variances, rows, jnp.zeros_like(mean)
    )


def transport(
    model: Model,
    params: Params,
    state: InformationState,
    time: Array,
    fade: Fade | None = None,
    noise: Array | None = None,
) -> InformationState:
    """The state at `time`, in either direction: variances as `fade` makes them (None: as they are),
    plus those of `noise` (n, n), a matrix L of which L L' is the process noise (at `time`)."""
    dtype = state.mean.dtype
    F, c = affine_flow(model, params, state.time, time, dtype)
    checks.shape("F", F, (state.mean.shape[0],) * 2)
    mean, rest = remainders.moved_with_rest(F, c, state.mean)
    variances = state.variances if fade is None else fade(state.variances)
    faded = state._replace(time=time, mean=mean, variances=variances)
    back, _ = affine_flow(model, params, time, state.time, dtype)
    # Chains of integrators have an upper triangular F: T F^-1 is then a unit upper triangular
    # matrix again but for a scaling of its rows, and nothing has to be made orthogonal.
    if noise is None and equations.is_upper(back):
        rows, diagonal = equations.carried(faded.rows, back)
        there = faded._replace(
            variances=_over(faded.variances, diagonal),
            rows=rows,
            targets=faded.targets / diagonal,
        )
    else:
        F, back = (dense(still_at_once(x, time == state.time)) for x in (F, back))
        there = moved(faded, F, back, noise)
        if model.steps is not None:
            # Of a part of the state, what is known cannot pass a singular F: no estimate after it
            # is the least-squares one. (Where F^-k only overflows, the part is forgotten.)
            partly = ~determined(state) & jnp.any(~jnp.isinf(state.variances))
            lost = partly & jnp.all(jnp.isnan(back))
            there = there._replace(variances=jnp.where(lost, jnp.nan, there.variances))
    return there._replace(targets=there.targets + equations.times(there.rows, rest))


def moved(
    state: InformationState, ahead: Array, back: Array, noise: Array | None = None
) -> InformationState:
    """The equations of a state whose reference has moved by `ahead` (n, n), with `noise` (n, k) of
    covariance L L' added; `back`, the inverse, is needed only while something is unknown.

    What is known of everything moves as a covariance, with no way back: there a motion that is
    stable and fast makes the certain more certain, and takes nothing from the rest.
    """
    n = state.mean.shape[0]
    # Both ways are computed and one is chosen at the end: variances that are infinite would make
    # NaN, or a NaN slope, in the one that is not.
    variances = jnp.where(jnp.isinf(state.variances), 1, state.variances)
    # x = T^-1 (targets + e): the errors e move along the columns of F T^-1, and Gram-Schmidt with
    # their variances makes a triangle of that again (Thornton 1976).
    vectors = matmul(ahead, equations.inverse(state.rows))
    error = matvec(vectors, state.targets)
    if noise is None:
        kept, rows = spread(vectors, variances)
    else:
        # F P F' + L L' is a sum over n + k independent errors: process noise is k more columns.
        both = jnp.concatenate([variances, jnp.ones(noise.shape[1], variances.dtype)])
        kept, rows = spread(jnp.concatenate([vectors, noise], 1), both, certain=True)
    targets = equations.times(rows, error)
    certain = state._replace(variances=kept, rows=rows, targets=targets)
    usable = jnp.all(jnp.isfinite(back))
    back = jnp.where(usable, back, jnp.eye(n, dtype=back.dtype))
    told = matmul(equations.upper(state.rows), back)
    sizes = matmul(jnp.abs(equations.upper(state.rows)), jnp.abs(back))
    spreads = jnp.where(usable, state.variances, jnp.inf)
    if noise is None:
        nothing = state._replace(**_nothing(state.mean))
        partial = gathered(nothing, told, spreads, state.targets, sizes)
    else:
        # Of (u, x) with noise L u, u of unit variance: u is eliminated by coming first.
        k = noise.shape[1]
        eye, zeros = jnp.eye(k, dtype=back.dtype), jnp.zeros((k, n), back.dtype)
        wide = jnp.concatenate(
            [jnp.concatenate([eye, zeros], 1), jnp.concatenate([-matmul(told, noise), told], 1)]
        )
        none = jnp.zeros(k + n, back.dtype)
        both = gathered(
            state._replace(mean=none, **_nothing(none)),
            wide,
            jnp.concatenate([jnp.ones(k, spreads.dtype), spreads]),
            jnp.concatenate([jnp.zeros(k, back.dtype), state.targets]),
            jnp.concatenate(
                [
                    jnp.concatenate([eye, zeros], 1),
                    jnp.concatenate([matmul(sizes, jnp.abs(noise)), sizes], 1),
                ]
            ),
        )
        partial = state._replace(
            variances=both.variances[k:],
            rows=both.rows[both.rows.shape[0] - state.rows.shape[0] :],
            targets=both.targets[k:],
        )
    return choose(determined(state), certain, partial)


def gathered(
    state: InformationState,
    told: Array,
    variances: Array,
    targets: Array,
    sizes: Array | None = None,
) -> InformationState:
    """The state with further equations (k, n), their variances (k,) and targets (k,), around the
    same reference; `sizes` (k, n) as in `absorbing.absorbed`."""
    kept, rows, leads, steps = absorbing.absorbed(
        state.variances, state.rows, told, variances, sizes
    )
    answers = absorbing.answered(state.targets, targets, leads, steps)
    return state._replace(variances=kept, rows=rows, targets=answers)


def joined(a: InformationState, b: InformationState) -> InformationState:
    """The information of two states of one time together, around a's mean if `a` determines one
    (else around b's), which keeps the targets short."""
    mean = jnp.where(determined(a), a.mean, b.mean)
    around = recentred_on(a, mean)
    other = recentred_on(b, mean)
    return gathered(around, equations.upper(b.rows), b.variances, other.targets)


def recentred_on(state: InformationState, mean: Array) -> InformationState:
    """The same information around another reference."""
    shift = state.mean - mean
    return state._replace(mean=mean, targets=state.targets + equations.times(state.rows, shift))


def blended(old: InformationState, new: InformationState, share: Array) -> InformationState:
    """(1 - share) times the information of `old` and `share` times that of `new`."""
    parts = (old, 1 - share), (new, share)
    faded = [
        s._replace(variances=grown(s.variances, bounded_reciprocal(part))) for s, part in parts
    ]
    return recentred(joined(*faded))


def absorb(
    model: Model,
    params: Params,
    state: InformationState,
    measurement: Measurement,
    growth: Array | float,
    exact: bool = False,
) -> tuple[InformationState, Info]:
    """The state with a measurement of any time, its R times `growth`, and its `Info`: one seen
    through a motion that has no way back, or (unless `exact`) without noise, is REJECTED."""
    found = sight(model, params, state.mean, state.time, measurement)
    return absorb_sight(state, found, measurement, growth, exact)


def absorb_sight(
    state: InformationState,
    found: Sight,
    measurement: Measurement,
    growth: Array | float,
    exact: bool = False,
) -> tuple[InformationState, Info]:
    """`absorb` of a measurement of which it is known how it is seen."""
    (seen, difference, R, size), mask = found, measurement.mask
    # No value decides here: runs that differ only in their values share what is not the targets.
    noise, good = noise_of(gaussian.mask_cov(R, mask), seen, exact)
    good &= ~jnp.any(jnp.isnan(state.variances))
    used = good & jnp.any(mask)
    # With R = L D L', rows of L^-1 H are equations with independent errors, which are added one by
    # one: no m x m matrix is inverted, and an exact component is a variance of 0.
    usable, residual = jnp.where(good, seen, 0), jnp.where(good, difference, 0)
    told, apart = cholesky.forward(noise.unit, usable), cholesky.forward(noise.unit, residual)
    sizes = None if size is None else summed(noise.unit, jnp.where(good, size, 0))
    spreads = jnp.where(used & mask, noise.variances * growth, jnp.inf)
    # Apart from the targets it depends on no data: runs share it.
    updated = gathered(state, told, spreads, apart, sizes)
    info = _info(state, usable, residual, R * growth, measurement, good, exact)
    # Variances outside of their domain are NaN here, and nothing is known from then on.
    is_broken = jnp.any(jnp.isnan(gaussian.mask_cov(R, mask)))
    updated = recentred(updated, used)
    return updated._replace(mean=jnp.where(is_broken, jnp.nan, updated.mean)), info


def contribution(
    model: Model, params: Params, state: InformationState, measurement: Measurement
) -> tuple[Array, Array, Array, Array]:
    """What one measurement says, as equations for `gathered`: whitened (m, n), targets (m,),
    variances (m,), infinite where nothing is said, and sizes (m, n)."""
    seen, difference, R, size = sight(model, params, state.mean, state.time, measurement)
    mask = measurement.mask
    noise, good = noise_of(gaussian.mask_cov(R, mask), seen)
    told = cholesky.forward(noise.unit, jnp.where(good, seen, 0))
    targets = cholesky.forward(noise.unit, jnp.where(good, difference, 0))
    size = jnp.abs(seen) if size is None else size
    sizes = summed(noise.unit, jnp.where(good, size, 0))
    return told, targets, jnp.where(good & mask, noise.variances, jnp.inf), sizes


def determined(state: InformationState) -> Array:
    """Whether something is known about every direction."""
    return largest(state.variances) < jnp.inf


def recentred(state: InformationState, used: Array | bool = True) -> InformationState:
    """The same information around the estimate, if there is one."""
    shift = equations.solved(state.rows, state.targets)
    shift = jnp.where(determined(state) & used, shift, 0)
    mean = state.mean + shift
    made = mean - state.mean  # what rounding lets the mean move by
    return state._replace(mean=mean, targets=state.targets - equations.times(state.rows, made))


def estimate(state: InformationState) -> Gaussian:
    """Mean and covariance of a state that is `recentred` whenever there is an estimate: the
    reference; NaN while something is unknown."""
    is_determined = determined(state)
    variances = jnp.where(is_determined, state.variances, 1)
    cov = equations.covariance(equations.inverse(state.rows), variances)
    return Gaussian(
        jnp.where(is_determined, state.mean, jnp.nan),
        symmetric.unpack(jnp.where(is_determined, cov, jnp.nan)),
    )


def _over(variances: Array, diagonal: Array) -> Array:
    return grown(variances, 1 / jnp.square(diagonal))


def _unknown(nothing: Array) -> tuple[Array, Array, Array]:
    n = nothing.shape[0]
    return jnp.full_like(nothing, jnp.inf), jnp.zeros(n * (n - 1) // 2, nothing.dtype), nothing


def _nothing(like: Array) -> dict[str, Array]:
    return dict(zip(("variances", "rows", "targets"), _unknown(jnp.zeros_like(like)), strict=True))


def _info(
    state: InformationState,
    seen: Array,
    difference: Array,
    R: Array,
    measurement: Measurement,
    good: Array,
    exact: bool,
) -> Info:
    mask = measurement.mask
    is_determined = determined(state)
    # H T^-1 diag(variances) T^-1' H' is the spread of what is predicted, without the covariance
    # itself.
    leads = equations.leading(state.rows, seen)
    variances = jnp.where(is_determined, state.variances, 1)
    spread = matmul(leads * variances[None], leads.T)
    size = None
    if exact:  # then the rounding of what is known already would count as its spread
        cov = equations.covariance(equations.inverse(state.rows), variances)
        size = gaussian.sizes(cov, seen, gaussian.mask_cov(R, mask))
    innovation = gaussian.innovate(
        difference - matvec(leads, state.targets), leads, spread + R, mask, size
    )
    used = is_determined & jnp.any(mask) & good
    return Info(
        jnp.where(is_determined | ~mask, innovation.value, jnp.nan),
        jnp.where(is_determined | ~(mask[:, None] & mask[None]), innovation.cov, jnp.nan),
        jnp.where(used, gaussian.log_density(innovation, mask), 0),
        state.time - measurement.time,
        jnp.where(good, jnp.int32(Status.USED), jnp.int32(Status.REJECTED)),
    )
