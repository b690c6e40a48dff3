"""What a study is made of, as a digest: the same in every process for the same code and numbers."""

import hashlib
import inspect
import types
from collections.abc import Callable, Iterator, Mapping
from functools import partial, singledispatch
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ewif_jax.recipe import FromRecipe

PACKAGE = Path(__file__).parents[1]
CONSTANT = (bool, int, float, complex, str, bytes, type(None), tuple, frozenset, types.CodeType)


def source_fingerprint() -> str:
    """A digest of the package's source code."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def digest_of(thing: Any) -> str:
    """Of content: numbers, what builders made, and functions by their code and all that it reads
    (closures, defaults, globals), through the user's own modules; installed packages by name."""
    digest = hashlib.sha256()
    for part in _digest_parts(thing, []):
        digest.update(part)
    return digest.hexdigest()[:16]


def _digest_parts(thing: Any, seen: list[Any]) -> Iterator[bytes]:
    """Bytes that tell apart what differs; `seen` holds what is being looked at or was before."""
    for number, earlier in enumerate(seen):
        if earlier is thing:
            yield f"as {number};".encode()
            return
    if isinstance(thing, FromRecipe) and thing.recipe is not None:
        recipe = thing.recipe
        yield f"built by {_qualified_name(recipe.builder)};".encode()
        yield from _digest_parts(dict(recipe.bound.arguments), seen)
        return
    # What cannot be a part of itself is told by content alone: whether two equal constants are one
    # object differs between processes.
    if not isinstance(thing, CONSTANT):
        seen.append(thing)
    yield f"{type(thing).__qualname__}:".encode()
    yield from _object_content(thing, seen)
    yield b";"


@singledispatch
def _object_content(thing: Any, seen: list[Any]) -> Iterator[bytes]:
    """Of an object of any class: its class, and what it holds."""
    yield _qualified_name(type(thing)).encode()
    held = getattr(thing, "__dict__", None)
    if held is not None:
        yield from _digest_parts(dict(held), seen)
    call = vars(type(thing)).get("__call__")
    if inspect.isfunction(call):
        yield from _digest_parts(call, seen)


@_object_content.register(bool | int | float | complex | str | bytes | type(None))
def _(thing: Any, seen: list[Any]) -> Iterator[bytes]:
    yield repr(thing).encode()


@_object_content.register(np.ndarray | np.generic | jax.Array)
def _(thing: Any, seen: list[Any]) -> Iterator[bytes]:
    if isinstance(thing, jax.Array) and jnp.issubdtype(thing.dtype, jax.dtypes.prng_key):
        yield str(thing.dtype).encode()
        thing = jax.random.key_data(thing)
    value = np.asarray(thing)
    yield f"{value.dtype}{value.shape}".encode()
    yield value.tobytes() if value.dtype.kind != "O" else repr(value.tolist()).encode()


@_object_content.register(tuple | list)
def _(thing: Any, seen: list[Any]) -> Iterator[bytes]:
    for part in thing:
        yield from _digest_parts(part, seen)


@_object_content.register(Mapping)
def _(thing: Any, seen: list[Any]) -> Iterator[bytes]:
    for name in sorted(thing, key=str):
        yield f"{name}=".encode()
        yield from _digest_parts(thing[name], seen)


@_object_content.register(set | frozenset)
def _(thing: Any, seen: list[Any]) -> Iterator[bytes]:
    yield from sorted(repr(part).encode() for part in thing)


@_object_content.register(partial)
def _(thing: Any, seen: list[Any]) -> Iterator[bytes]:
    yield from _digest_parts((thing.func, thing.args, thing.keywords), seen)


@_object_content.register(types.MethodType)
def _(thing: Any, seen: list[Any]) -> Iterator[bytes]:
    yield from _digest_parts((thing.__func__, thing.__self__), seen)


@_object_content.register(types.ModuleType | type)
def _(thing: Any, seen: list[Any]) -> Iterator[bytes]:
    yield _qualified_name(thing).encode()


@_object_content.register(types.CodeType)
def _(thing: Any, seen: list[Any]) -> Iterator[bytes]:
    yield thing.co_code
    yield repr((thing.co_names, thing.co_varnames, thing.co_freevars)).encode()
    yield from _digest_parts(thing.co_consts, seen)


@_object_content.register(types.FunctionType)
def _(thing: Any, seen: list[Any]) -> Iterator[bytes]:
    if _is_installed(thing):
        yield _qualified_name(thing).encode()
        cells = thing.__closure__ or ()
        yield from _digest_parts([_held_value(cell) for cell in cells], seen)
        return
    yield from _digest_parts(thing.__code__, seen)
    yield from _digest_parts((thing.__defaults__, thing.__kwdefaults__), seen)
    cells = zip(thing.__code__.co_freevars, thing.__closure__ or (), strict=True)
    yield from _digest_parts({name: _held_value(cell) for name, cell in cells}, seen)
    read = {n: thing.__globals__[n] for n in _names_read(thing.__code__) if n in thing.__globals__}
    yield from _digest_parts(read, seen)


def _names_read(code: types.CodeType) -> set[str]:
    """What a function and the functions in it read by name."""
    inner = (x for x in code.co_consts if isinstance(x, types.CodeType))
    return set(code.co_names).union(*map(_names_read, inner))


def _held_value(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not filled yet
        return None


def _is_installed(function: Callable[..., Any]) -> bool:
    """Whether it is of a package whose version is noted elsewhere, not the user's own."""
    file = Path(inspect.getfile(function))
    return file.is_relative_to(PACKAGE) or "site-packages" in file.parts or _is_of_python(file)


def _is_of_python(file: Path) -> bool:
    return file.is_relative_to(Path(inspect.__file__).parent)


def _qualified_name(thing: Any) -> str:
    module = getattr(thing, "__module__", "")
    return f"{module}.{getattr(thing, '__qualname__', getattr(thing, '__name__', thing))}"
