"""Reading `params`, and saying which name was wrong."""

from collections.abc import Callable, Mapping
from functools import wraps
from inspect import Parameter, signature
from operator import attrgetter, itemgetter
from typing import Any

import jax

from ewif_jax.types import Numbers, Params


def resolve(value: Numbers, params: Params) -> Any:
    """`value(params)` if it is a function of the parameters, else `value`."""
    return named(value)(params) if callable(value) else value


def named(value: Numbers) -> Any:
    """A function of (params, ...) that says which name it asked for and `params` has not; anything
    else as it is."""
    return _is_named(value) if callable(value) else value


def of_params(value: Numbers) -> bool:
    """Whether it is a function of `params` alone."""
    if isinstance(value, itemgetter | attrgetter):
        return True
    if not callable(value):
        return False
    try:
        found = signature(value).parameters.values()
    except (TypeError, ValueError):  # what Python cannot look into is asked with all arguments
        return False
    positional = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
    if any(one.kind is Parameter.VAR_POSITIONAL for one in found):
        return False
    return sum(one.kind in positional for one in found) == 1


def with_time(value: Numbers) -> bool:
    """Whether it is a function that cannot be asked without a time beside `params`."""
    if not callable(value) or isinstance(value, itemgetter | attrgetter):
        return False
    try:
        found = signature(value).parameters.values()
    except (TypeError, ValueError):
        return False
    positional = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
    needed = [one for one in found if one.kind in positional and one.default is Parameter.empty]
    return len(needed) == 2


def _is_named(value: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(value)
    def call(params: Params, *args: Any) -> Any:
        try:
            return value(params, *args)
        except KeyError as error:
            if not isinstance(params, Mapping):
                raise
            raise ValueError(
                f"params: expected the name {error}, which {_name_of(value)} reads, got "
                f"{_names_in(params)}"
            ) from error
        except TypeError as error:
            if params is not None or "NoneType" not in str(error):
                raise
            raise ValueError(f"params: expected what {_name_of(value)} reads, got None") from error

    return call


def _name_of(value: Numbers) -> str:
    return getattr(value, "__name__", "a function").replace("<lambda>", "a lambda of the model")


def _names_in(params: Params) -> str:
    paths = [path for path, _ in jax.tree.leaves_with_path(params)]
    return ", ".join(jax.tree_util.keystr(path) for path in paths) or "nothing"
