"""Answers that are kept, so that the same question is not worked out again.

Checks and trials of a call take longer than filtering a short stream: asking again costs some
microseconds. What is kept holds neither arrays nor the bytes of parameters nor functions of the
user: they are told apart by digests and weak references.
"""

from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import wraps
from threading import Lock
from typing import ParamSpec, TypeVar
from weakref import ref

import jax
from jax import Array
from jax.core import Tracer

from ewif_jax.recipe import FromRecipe, NotConcreteError, content_key

Given = ParamSpec("Given")
Answer = TypeVar("Answer")

MOST_ANSWERS = 1000
"""How many are kept: a study asks of some hundred filters and streams in turns."""
MOST_LEAVES = 100
"""Of a question: to look up one of more takes as long as many a check."""


class Memo:
    """A table of the answers used last; the one unused for longest goes first."""

    def __init__(self, most: int):
        self.most = most
        self._answers: OrderedDict[Hashable, object] = OrderedDict()
        self._lock = Lock()

    def __len__(self) -> int:
        return len(self._answers)

    def get(self, question: Hashable) -> object | None:
        """What was kept for it, or None."""
        with self._lock:
            if question not in self._answers:
                return None
            self._answers.move_to_end(question)
            return self._answers[question]

    def keep(self, question: Hashable, answer: object) -> None:
        """Keeps an answer (not None)."""
        with self._lock:
            self._answers[question] = answer
            self._answers.move_to_end(question)
            while len(self._answers) > self.most:
                self._answers.popitem(last=False)

    def clear(self) -> None:
        """Forgets all."""
        with self._lock:
            self._answers.clear()


ANSWERS = Memo(MOST_ANSWERS)
"""The one that the package has."""


def remembered(question: Hashable, work_out: Callable[[], Answer]) -> Answer:
    """The answer to a question that determines it; `None` asks without keeping."""
    if question is None:
        return work_out()
    kept = ANSWERS.get(question)
    if not isinstance(kept, tuple):
        kept = (work_out(),)  # in a tuple, for an answer may be None
        ANSWERS.keep(question, kept)
    return kept[0]


def question_of(*parts: object) -> Hashable | None:
    """What tells questions of such content apart, or None while something is being traced."""
    try:
        return content_key(parts)
    except NotConcreteError:
        return None


def once(check: Callable[Given, Answer]) -> Callable[Given, Answer]:
    """`check`, whose answer for the same arrays of JAX (they cannot change) and things of equal
    content is kept; what it refuses it refuses each time."""

    @wraps(check)
    def call(*args: Given.args, **kwargs: Given.kwargs) -> Answer:
        leaves, structure = jax.tree.flatten((args, kwargs), is_leaf=_is_value)
        arrays = [x for x in leaves if isinstance(x, Array)]
        if not arrays or len(leaves) > MOST_LEAVES or not all(map(_is_fixed, leaves)):
            return check(*args, **kwargs)
        try:
            # Arrays of JAX cannot change, so their address says which they are as long as they
            # live; to read them would wait for the device and cost more than many a check.
            told = [id(x) if isinstance(x, Array) else (content_key(x),) for x in leaves]
        except NotConcreteError:
            return check(*args, **kwargs)
        question = check, structure, *told
        kept = ANSWERS.get(question)
        # An array that came to where another one was is not that one.
        if isinstance(kept, tuple) and all(
            was() is x for was, x in zip(kept[0], arrays, strict=True)
        ):
            return kept[1]
        answer = check(*args, **kwargs)
        ANSWERS.keep(question, ([ref(x) for x in arrays], answer))
        return answer

    return call


def _is_value(x: object) -> bool:
    return isinstance(x, FromRecipe)


def _is_fixed(x: object) -> bool:
    """Whether it will stay what it is."""
    return isinstance(x, Array | FromRecipe | Hashable) and not isinstance(x, Tracer)
