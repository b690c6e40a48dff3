"""The room `fast/`: it knows no model and no filter; its memo keeps answers, not arrays."""

import ast
import gc
import weakref
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax import checks
from ewif_jax.fast import compiling, memo
from ewif_jax.fast.blocks import Portion, scan_in_blocks
from ewif_jax.fast.memo import Memo, once, question_of, remembered

ROOM = Path(memo.__file__).parent
BELOW = ("ewif_jax.recipe", "ewif_jax.plain", "ewif_jax.types", "ewif_jax.checks", "ewif_jax.fast")
PRIOR = ej.Gaussian(np.zeros(1), np.eye(1))
STREAM = ej.stream(np.arange(1.0, 4.0), np.zeros(3))


def strangers(source):
    """What a file of the room imports of the package and may not."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            within = node.module == "ewif_jax"
            found += [f"{node.module}.{a.name}" if within else node.module for a in node.names]
    ours = [name for name in found if name and name.split(".")[0] == "ewif_jax"]
    return [name for name in ours if not name.startswith(BELOW)]


@pytest.mark.parametrize("file", sorted(ROOM.glob("*.py")), ids=lambda file: file.stem)
def test_no_file_imports_a_model_or_a_filter(file):
    assert strangers(file.read_text()) == []


@pytest.mark.parametrize(
    "planted",
    [
        "from ewif_jax.models import Model",
        "def f():\n    import ewif_jax.estimators.kalman",
        "from ewif_jax import models",
    ],
)
def test_a_planted_import_is_found(planted):
    assert strangers(planted)


def test_the_readme_speaks_of_every_file():
    text = (ROOM / "README.md").read_text()
    files = {file.name for file in ROOM.glob("*.py")} - {"__init__.py"}
    assert {name for name in files if f"`{name}`" not in text} == set()


def test_what_is_unused_for_longest_is_forgotten_first():
    table = Memo(3)
    for k in range(3):
        table.keep(k, (k,))
    assert table.get(0) == (0,)
    table.keep(3, (3,))
    assert [table.get(k) for k in range(4)] == [(0,), None, (2,), (3,)]
    assert len(table) == 3


def test_what_fails_is_asked_again():
    asked = []

    def fails():
        asked.append(0)
        raise ValueError("no answer")

    for _ in range(2):
        with pytest.raises(ValueError, match="no answer"):
            remembered(("a question of this test",), fails)
    assert len(asked) == 2


def test_a_stream_is_looked_at_once_while_it_cannot_change(monkeypatch):
    looks = []
    vdot = np.vdot
    monkeypatch.setattr(np, "vdot", lambda a, b: looks.append(0) or vdot(a, b))
    kalman = ej.kalman(ej.models.random_walk(sensors=ej.models.position_sensor(1.0), q=1.0))
    fixed = ej.Measurement(*map(jnp.asarray, STREAM))
    ej.run(kalman, None, fixed, prior=PRIOR, t0=0.0)
    first = len(looks)
    ej.run(kalman, None, fixed, prior=PRIOR, t0=0.0)
    second = len(looks) - first
    assert second < first
    changes = STREAM._replace(value=np.zeros((3, 1)))
    ej.run(kalman, None, changes, prior=PRIOR, t0=0.0)
    changes.value[1] = np.nan
    with pytest.raises(ValueError, match=r"measurements\.value: expected finite numbers"):
        ej.run(kalman, None, changes, prior=PRIOR, t0=0.0)


def test_an_answer_is_kept_for_the_same_arrays_alone():
    asked = []

    @once
    def check(*args, **kwargs):
        asked.append(args[1:])  # not the first: it shall be gone after its check
        checks.require(kwargs.get("good", True), "good", "True", False)
        return len(asked)

    x, y = jnp.zeros(2), jnp.zeros(2)
    assert [check(x, 1), check(x, 1), check((x,), 1), check(x, 1)] == [1, 1, 2, 1]
    assert [check(y, 1), check(x, 1.0), check(x, True), check(1, x)] == [3, 4, 5, 6]
    assert [check(x, good=True), check(x, good=True)] == [7, 7]
    changes = np.zeros(2)
    assert [check(x, changes), check(x, changes)] == [8, 9]
    assert [check(2), check(2)] == [10, 11]  # no array: as quick as looking it up
    for count in (12, 13):
        with pytest.raises(ValueError, match="good: expected True, got False"):
            check(x, good=False)
        assert len(asked) == count
    jax.jit(lambda t: check(t) * t)(1.0)
    jax.jit(lambda t: check(t) * (t + 1))(1.0)
    assert len(asked) == 15
    for k in range(20):  # a new array may come to where an old one was
        check(jnp.full(2, k))
    assert len(asked) == 35
    filters = [ej.kalman(ej.linear_model(np.eye(1), np.eye(1), np.eye(1))) for _ in range(2)]
    assert [check(x, each) for each in filters] == [36, 36]  # equal filters are one


def test_questions_of_equal_content_are_one():
    big = np.arange(1000.0)
    assert question_of({"q": big}, 1) == question_of({"q": big.copy()}, 1)
    assert question_of({"q": big}, 1) != question_of({"q": big + 1}, 1)
    assert question_of({"q": big}, 1) != question_of({"q": big}, 1.0)
    assert question_of({"q": big}) != question_of({"q": big.astype(np.float32)})
    asked = []
    jax.jit(lambda t: asked.append(question_of(t)) or t)(1.0)
    assert asked == [None]


class Closure:
    """A function with a table that would be missed if it stayed."""

    def __init__(self):
        self.table = np.ones((1, 1))

    def __call__(self, params, sensor, t):
        return jnp.asarray(self.table) * params["c"][0]


def filtered(entry, H, params):
    model = ej.linear_model(np.eye(1), H, np.eye(1))
    setting = {"prior": PRIOR, "t0": 0.0}
    if entry == "run":
        ej.run(ej.kalman(model), params, STREAM, **setting)
    elif entry == "run_batch":
        batch = STREAM._replace(value=jnp.zeros((2, 3, 1)))
        ej.run_batch(ej.kalman(model), params, batch, **setting)
    else:
        other = STREAM._replace(sensor=jnp.ones(3, jnp.int32))
        table = ej.linear_model(np.eye(1), lambda p, s, t: H(p, s, t)[None][s], np.eye(1))
        with pytest.raises(ValueError, match=r"measurement\.sensor"):
            ej.run(ej.kalman(table), params, other, **setting)


@pytest.mark.parametrize("entry", ["run", "run_batch", "looked up"])
def test_the_memo_keeps_neither_parameters_nor_functions(entry):
    H = Closure()
    params = {"c": jnp.ones(10_000)}
    gone = [weakref.ref(H), weakref.ref(params["c"])]
    memo.ANSWERS.clear()
    filtered(entry, H, params)
    assert len(memo.ANSWERS) > 0
    questions = [str(question) for question in memo.ANSWERS._answers]
    assert max(map(len, questions)) < 20_000  # of 80,000 bytes
    del H, params
    jax.clear_caches()
    gc.collect()
    assert [was() is None for was in gone] == [True, True]


def test_options_that_xla_does_not_know_are_left_out_one_by_one(monkeypatch):
    """Another XLA knows others: what it does not know must not cost the rest, or the call."""
    unknown = dict.fromkeys(("xla_cpu_not_yet_thought_of", "xla_cpu_dropped_long_ago"), True)
    before = compiling._known_options()
    monkeypatch.setattr(compiling, "QUICKEST", {**unknown, **compiling.QUICKEST})
    compiling._known_options.cache_clear()
    try:
        assert compiling._known_options() == before
        quick = compiling.quick_jit(lambda x: x + 1, (), compiling.QUICKEST)
        assert quick(jnp.float32(1.0)) == 2.0
    finally:
        compiling._known_options.cache_clear()


def in_blocks(rate, shift, together):
    """A loop whose arrivals are differentiated too, a block of four steps at a time."""
    arrivals = jnp.arange(8.0) - shift * (jnp.arange(8.0) % 3)

    def step(state, arrival):
        state = jnp.sin(rate * (state + arrival**3))
        return state, state

    portion = Portion(1, 4, together)
    seen, _ = scan_in_blocks(step, jnp.zeros(()), arrivals, lambda y: y[None], portion, None)
    return seen.sum()


@pytest.mark.parametrize("together", [False, True])
def test_slopes_of_every_order_go_to_what_is_read_from_the_whole(together):
    """Forward over reverse lost those of what arrives, which tuned latencies move."""

    def loss(x):
        return in_blocks(*x, together)

    at = jnp.array([0.7, 0.3])
    wanted = jax.jacfwd(jax.jacfwd(lambda x: in_blocks(*x, False)))(at)
    assert np.abs(wanted).min() > 1
    for outer, inner in ((jax.jacfwd, jax.grad), (jax.jacrev, jax.grad), (jax.jacrev, jax.jacfwd)):
        np.testing.assert_allclose(outer(inner(loss))(at), wanted, rtol=1e-9)
    for k, other in ((0, 1), (1, 0)):  # of one alone, then of the other

        def slope(*x, k=k):
            return jax.grad(in_blocks, k)(*x, together)

        np.testing.assert_allclose(jax.grad(slope, other)(*at), wanted[0, 1], rtol=1e-9)
