"""What a filter asks of a model: where the state will be and what a sensor will say, with the
derivatives of both."""

import jax
import jax.numpy as jnp
from jax import Array

from ewif_jax import checks
from ewif_jax.fast.small import matvec
from ewif_jax.fast.sparse import Matrix, with_zeros
from ewif_jax.models.model import Linear, Model, affine
from ewif_jax.models.sensor_range import check_sensor
from ewif_jax.plain import in_dtype
from ewif_jax.types import DTypeLike, Numbers, Params


def predict_state(
    model: Model, params: Params, x: Array, t0: Array, t1: Array
) -> tuple[Array, Array | Matrix, Array]:
    """x at t1 (n,), the Jacobian F (n, n) of the motion at x, and Q (n, n) for t1 >= t0."""
    Q = jnp.asarray(model.process_cov(params, t0, t1), x.dtype)
    if model.linear is not None:
        F, c = affine_flow(model, params, t0, t1, x.dtype)
        checks.shape("F", F, (x.shape[0],) * 2)
        moved = matvec(F, x)
        return (moved if c is None else moved + c), F, Q

    def move(x: Array) -> Array:
        return jnp.asarray(model.transition(params, x, t0, t1), x.dtype)

    F = jax.jacfwd(move)(x)
    checks.shape("F", F, (x.shape[0],) * 2)
    return move(x), F, Q


def predict_measurement(
    model: Model, params: Params, x: Array, sensor: Array, t: Array
) -> tuple[Array, Array | Matrix, Array]:
    """Predicted measurement (m,), its Jacobian H (m, n) at x, and R (m, m)."""
    check_sensor(model, params, x, sensor, t)
    R = noise_at(model, params, x, sensor, t)
    if model.linear is not None:
        H = with_zeros(
            jnp.asarray(model.linear.H(params, sensor, t), x.dtype), model.linear.H_where
        )
        checks.shape("H", H, ("m", x.shape[0]))
        checks.shape("R", R, (H.shape[0],) * 2)
        return predicted_value(model, params, H, x, sensor, t), H, R

    def see(x: Array) -> Array:
        return jnp.asarray(model.observe(params, x, sensor, t), x.dtype)

    H = jax.jacfwd(see)(x)
    checks.shape("R", R, (H.shape[0],) * 2)
    return see(x), H, R


def affine_flow(
    model: Model, params: Params, t0: Array, t1: Array, dtype: DTypeLike
) -> tuple[Array | Matrix, Array | None]:
    """F (n, n) and c (n,) or None of a linear model: x(t1) = F x(t0) + c, in either direction.

    Against time c is derived from the forward input: c(t1, t0) = -F(t1, t0) b(t0, t1).
    """
    linear = need_linear(model, "this operation")
    F, c = affine(linear.F, linear.b, params, t0, t1, dtype)
    return with_zeros(F, linear.F_where), c


def noise_at(model: Model, params: Params, x: Array, sensor: Array, t: Array) -> Array:
    """R (m, m) of a measurement that is predicted from the state x (n,)."""
    R = in_dtype(model.measurement_cov(params, sensor, t), x.dtype)
    return R if model.jitter is None else R + model.jitter(params, x, sensor, t)


def predicted_value(
    model: Model, params: Params, H: Array | Matrix, x: Array, sensor: Array, t: Array
) -> Array:
    """What a linear sensor of matrix H says of x (n,): H x, and its offset if there is one."""
    seen, linear = matvec(H, x), need_linear(model, "this operation")
    if linear.offset is None:
        return seen
    return seen + jnp.asarray(linear.offset(params, sensor, t), seen.dtype)


def observation(
    model: Model, params: Params, sensor: Array, t: Array, dtype: DTypeLike
) -> tuple[Array | Matrix, Array]:
    """H (m, n) and R (m, m) of a linear model."""
    linear = need_linear(model, "this operation")
    check_sensor(model, params, None, sensor, t)
    H = with_zeros(jnp.asarray(linear.H(params, sensor, t), dtype), linear.H_where)
    return H, in_dtype(model.measurement_cov(params, sensor, t), dtype)


def size(model: Model, params: Params, t0: Numbers) -> int:
    """n, read off a linear model without computing anything."""
    linear = need_linear(model, "prior=None")
    return jax.eval_shape(lambda: jnp.asarray(linear.F(params, t0, t0))).shape[0]


def need_model(model: Model, method: str) -> None:
    """Refuses what is not a model, for the method that wants one."""
    ok = isinstance(model, Model)
    expected = f"a Model (linear_model(...), models.*) for {method}"
    checks.require(ok, "model", expected, f"a {type(model).__name__}")


def need_linear(model: Model, method: str, instead: str = "use `extended`") -> Linear:
    """The matrices of `model`, or an error that says which method wanted them, and what to do
    `instead`."""
    need_model(model, method)
    checks.require(
        model.linear is not None,
        "model",
        f"a linear model: {method} needs F and H ({instead} for a nonlinear one)",
        "a Model without matrices",
    )
    assert model.linear is not None
    return model.linear


def need_known_noise(model: Model, method: str) -> None:
    """Refuses a model whose R depends on the state, for a method that needs it before there is an
    estimate."""
    checks.require(
        model.jitter is None,
        "model",
        f"a model whose R does not depend on the state: {method} needs it before there is one",
        "a jittered model",
    )


def need_reversible(model: Model, method: str) -> Model:
    """`model`, unless it is known that its motion cannot be followed back."""
    checks.require(
        model.linear is None or model.linear.reversible,
        "model",
        f"a model whose F has an inverse: {method} asks where a state came from",
        "a singular F",
    )
    return model
