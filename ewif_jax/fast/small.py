"""Products of small matrices that stay fast under `vmap`.

XLA's CPU backend turns a batch of tiny matrix products into one scalar loop per matrix. Here a
product whose other factor is shared by the batch becomes one large product, with the batch as its
last (contiguous) axis, and a product of two batched factors becomes a sum of elementwise products.
Both are exact rewritings; only the layout differs from `jnp.matmul`.
"""

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from ewif_jax.fast.batched import contiguous, kernel, stage, total
from ewif_jax.fast.sparse import Matrix, Pattern, apart, dense, multiplied, product


def matmul(a: Array | Matrix, b: Array | Matrix) -> Array:
    """`a @ b` for two matrices, without the zeros that a carries; under `vmap` the result is
    batched along its last axis."""
    values, where = apart(a)
    if where is None:
        return _matmul_p.bind(values, dense(b))
    return _sparse_product(where)(values, dense(b))


def matvec(a: Array | Matrix, x: Array) -> Array:
    """`a @ x` for a matrix and a vector, as `matmul`."""
    values, where = apart(a)
    return matmul(values, x[:, None])[:, 0] if where is None else _sparse_product(where)(values, x)


@cache
def _sparse_product(where: Pattern) -> Callable[[Array, Array], Array]:
    return kernel(lambda a, x: product(a, x, where), cheap=True)


def _dot_product(a: Array, b: Array) -> Array:
    # Up to here one fused loop is faster than a call of a library (3 microseconds). Found by
    # measuring (`README.md`: "A single matrix is computed whole").
    if a.size * b.shape[1] <= (256 if b.shape[1] > 16 else 4096):
        return multiplied(a, b)
    # A transposed factor would take a slower library.
    return lax.dot(contiguous(a), b, precision=lax.Precision.HIGHEST)


def _product_shape(a, b):
    return ShapedArray((a.shape[0], b.shape[1]), jnp.promote_types(a.dtype, b.dtype))


def _batch_product(args, dims):
    a, b = args
    da, db = dims
    if da is None:  # (i,k) . (k,j*R): one product, batch last
        b = jnp.moveaxis(b, db, -1)
        k, j, r = b.shape
        return matmul(a, b.reshape(k, j * r)).reshape(a.shape[0], j, r), 2
    a = jnp.moveaxis(a, da, -1)
    if db is None:  # a.b = (I x b') vec(a): again one product without a transposition
        i, k, r = a.shape
        blocks = jnp.kron(jnp.eye(i, dtype=b.dtype), b.T)
        return matmul(blocks, a.reshape(i * k, r)).reshape(i, b.shape[1], r), 2
    b = jnp.moveaxis(b, db, -1)
    return stage(_sum_of_products, a, b, batch=1), 2


def _sum_of_products(a: Array, b: Array) -> Array:
    return total(a[:, k, None] * b[None, k] for k in range(a.shape[1]))


_matmul_p = Primitive("small_matmul")
_matmul_p.def_impl(jax.jit(_dot_product))
_matmul_p.def_abstract_eval(_product_shape)
mlir.register_lowering(_matmul_p, mlir.lower_fun(_dot_product, multiple_results=False))
ad.defbilinear(
    _matmul_p,
    lambda ct, a, b: matmul(ct, b.T),
    lambda ct, a, b: matmul(a.T, ct),
)
batching.primitive_batchers[_matmul_p] = _batch_product
