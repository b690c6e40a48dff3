"""What was built knows its builder and what that got: equality, hash, pickle and repr follow.

Two filters made alike are one filter, so `run` compiles nothing again for the second, and either
can be sent to another process.
"""

import copy
import inspect
from collections.abc import Callable, Hashable
from functools import cached_property, partial, wraps
from hashlib import blake2b
from types import MethodType
from typing import Any, ParamSpec, TypeVar
from weakref import ref

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

Given = ParamSpec("Given")
Made = TypeVar("Made", bound="FromRecipe")

LONGEST_RAW = 64
"""Bytes up to which arrays are compared as they are. What is longer is compared by its digest, so
that a key holds no memory of an array."""


class FromRecipe:
    """For a named tuple that builders make: one that was made by a builder equals what was made by
    the same builder from equal arguments; any other is equal where its fields are.

    Arrays, numbers and sequences of them are equal by content, functions by identity. With an
    argument that is being traced an object equals only itself.
    """

    @property
    def recipe(self) -> "Recipe | None":
        """How it was built, or None."""
        return self.__dict__.get("_recipe")

    def __hash__(self) -> int:
        recipe = self.__dict__.get("_recipe")
        return tuple.__hash__(self) if recipe is None else recipe.hash  # pyright: ignore

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        mine, other_recipe = self.recipe, getattr(other, "recipe", None)
        if mine is None and other_recipe is None:
            return tuple.__eq__(self, other)  # pyright: ignore
        if mine is None or not isinstance(other_recipe, Recipe) or type(self) is not type(other):
            return False
        return mine.hash == other_recipe.hash and mine.key == other_recipe.key

    def __ne__(self, other: object) -> bool:
        return not self == other  # else a tuple's own would be asked

    def __reduce__(self) -> tuple[Any, ...]:
        recipe = self.recipe
        if recipe is None:
            return type(self), tuple(self)  # pyright: ignore
        return _built_again, (recipe.builder, recipe.args, recipe.kwargs)

    def __copy__(self: Made) -> Made:
        return self

    def __deepcopy__(self: Made, memo: Any) -> Made:
        if self.recipe is not None:
            return self  # nothing in it can change
        return type(self)(*(copy.deepcopy(field, memo) for field in self))  # pyright: ignore

    def __repr__(self) -> str:
        recipe = self.recipe
        return super().__repr__() if recipe is None else recipe.shown(depth=1)


def from_recipe(builder: Callable[Given, Made]) -> Callable[Given, Made]:
    """`builder`, a function of a module, whose results know it and its arguments."""
    signature = inspect.signature(builder)

    @wraps(builder)
    def build(*args: Given.args, **kwargs: Given.kwargs) -> Made:
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError:
            return builder(*args, **kwargs)  # which says better what is wrong
        bound.apply_defaults()
        for name, value in bound.arguments.items():
            bound.arguments[name] = settled(value)
        made = builder(*bound.args, **bound.kwargs)
        # A builder may return what another builder made (a wrapper that changes nothing): written
        # on that object, the recipe would rename it for everybody who holds it.
        own = type(made)(*made)  # pyright: ignore  (it may be what another builder made)
        own.__dict__["_recipe"] = Recipe(build, bound)
        return own

    return build


def _built_again(builder: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    return builder(*args, **kwargs)


class Recipe:
    """A builder and its arguments."""

    def __init__(self, builder: Callable[..., Any], bound: inspect.BoundArguments):
        self.builder = builder
        self.bound = bound
        # Constants take the widest dtype that there is when they are built.
        self.x64 = bool(jax.config.jax_enable_x64)  # pyright: ignore

    @property
    def args(self) -> tuple[Any, ...]:
        """Arguments by position."""
        return self.bound.args

    @property
    def kwargs(self) -> dict[str, Any]:
        """Arguments by name."""
        return self.bound.kwargs

    @cached_property
    def key(self) -> Hashable:
        """Equal for equal recipes; of its own while an argument is traced."""
        try:
            return self.concrete_key
        except NotConcreteError:
            return Same(self)

    @cached_property
    def concrete_key(self) -> Hashable:
        """The same, or an error while an argument is traced."""
        named = tuple((name, content_key(x)) for name, x in self.bound.arguments.items())
        return Same(self.builder), self.x64, named

    @cached_property
    def hash(self) -> int:
        """Of the key; worked out once."""
        return hash(self.key)

    def shown(self, depth: int) -> str:
        """The call that makes it, in short."""
        parts = []
        for name, parameter in inspect.signature(self.builder).parameters.items():
            value = self.bound.arguments[name]
            if parameter.default is inspect.Parameter.empty:
                parts.append(_shown_value(value, depth))
            elif value is not parameter.default and not _same_content(value, parameter.default):
                parts.append(f"{name}={_shown_value(value, depth)}")
        inside = ", ".join(parts) if depth or not parts else "..."
        return f"{self.builder.__name__}({inside})"


class NotConcreteError(TypeError):
    """Asked for the content of what is being traced."""


class Same:
    """Stands for a thing that equals only itself."""

    def __init__(self, thing: Any):
        self.thing = thing

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and self.thing is other.thing

    def __hash__(self) -> int:
        return id(self.thing)


def is_concrete(x: "FromRecipe") -> bool:
    """Whether nothing that it was built from is being traced."""
    recipe = x.recipe
    return recipe is None or not isinstance(recipe.key, Same)


def settled(x: Any) -> Any:
    """`x` so that nobody else can change it: arrays of NumPy copied, lists as tuples."""
    if isinstance(x, FromRecipe):
        return x
    if isinstance(x, np.ndarray):
        own = np.array(x, subok=True)
        own.setflags(write=False)
        return own
    if type(x) in (list, tuple):
        return tuple(map(settled, x))
    if isinstance(x, tuple) and hasattr(x, "_fields"):
        return type(x)(*map(settled, x))
    if type(x) is dict:
        return {name: settled(value) for name, value in x.items()}
    return x


def content_key(x: Any) -> Hashable:
    """Equal for things of equal content; keeps neither arrays nor functions alive.

    Raises:
        NotConcreteError: something in it is being traced.
    """
    if isinstance(x, Tracer):
        raise NotConcreteError
    if isinstance(x, FromRecipe) and x.recipe is not None:
        return x.recipe.concrete_key
    # With its type: True == 1 == 1.0 in Python, but they make different programs.
    if x is None or isinstance(x, bool | int | str | bytes):
        return type(x), x
    if isinstance(x, np.ndarray | np.generic | jax.Array):
        return _array_key(x)
    if isinstance(x, float | complex):
        return type(x), repr(x)  # tells 0.0 from -0.0, and is the same for every NaN
    if isinstance(x, list | tuple):
        return _kind_of(x), *map(content_key, x)
    if isinstance(x, dict):
        return dict, frozenset((content_key(k), content_key(value)) for k, value in x.items())
    if isinstance(x, partial):
        return partial, *map(content_key, (x.func, x.args, x.keywords))
    if isinstance(x, MethodType):
        return MethodType, content_key(x.__func__), content_key(x.__self__)
    return _reference_of(x)


def _kind_of(x: Any) -> type:
    return type(x) if hasattr(x, "_fields") else tuple


def _array_key(x: Any) -> Hashable:
    if isinstance(x, np.ma.MaskedArray):
        return np.ma.MaskedArray, _array_key(x.data), _array_key(np.ma.getmaskarray(x))
    dtype = x.dtype
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        x = jax.random.key_data(x)
    value = np.asarray(x)
    if value.dtype.hasobject:
        return Same(x)
    # A weak type promotes differently, so it makes another program of the same numbers.
    return value.shape, dtype, digest(value), getattr(x, "weak_type", False)


def digest(value: np.ndarray) -> bytes:
    """The bytes of an array if they are few, else 16 that stand for them."""
    raw = value.tobytes()
    return raw if len(raw) <= LONGEST_RAW else blake2b(raw, digest_size=16).digest()


def _reference_of(x: Any) -> Hashable:
    """A weak reference, which is equal while the things are equal and alive."""
    try:
        hash(x)
    except TypeError:
        return Same(x)
    try:
        return ref(x)
    except TypeError:
        return x


def _same_content(a: Any, b: Any) -> bool:
    try:
        return content_key(a) == content_key(settled(b))
    except NotConcreteError:
        return False


def _shown_value(x: Any, depth: int) -> str:
    if not depth:
        return "..."
    if isinstance(x, FromRecipe) and x.recipe is not None:
        return x.recipe.shown(depth - 1)
    if isinstance(x, np.ndarray | jax.Array):
        return f"{x.dtype}{list(x.shape)}"
    if isinstance(x, tuple):
        return f"({', '.join(_shown_value(each, depth) for each in x)})" if len(x) < 5 else "(...)"
    if callable(x):
        return getattr(x, "__name__", type(x).__name__)
    return repr(x)
