"""A bank of EWIFs is the Bayesian mixture of its members (recursion in NumPy), pays at most the
stated regret, and follows a target that is quiet, manoeuvres and is quiet again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej

TAUS = np.geomspace(0.4, 12.8, 6)
MODEL = ej.models.constant_velocity(sensors=ej.models.position_sensor(lambda p: p["r"]))
PARAMS = {"r": jnp.asarray(1.0), "forgetting": jnp.asarray(0.95), "taus": jnp.asarray(TAUS)}
BANK = ej.ewif_bank(MODEL, lambda p: p["taus"], lambda p: p["forgetting"])
R, T, DT = 40, 200, 0.3
TIME = DT * np.arange(1, T + 1)
RNG = np.random.default_rng(0)
PUSH = np.where((TIME > 20) & (TIME < 40), 4 * np.sin(1.2 * (TIME - 20)), 0)
PATH = np.cumsum(np.cumsum(PUSH)) * DT**2
ORDER = np.argsort(TIME + np.where(RNG.uniform(size=T) < 0.3, 0.7, 0), kind="stable")
VALUE = PATH + RNG.normal(size=(R, T))
PRESENT = RNG.uniform(size=T) > 0.1
BATCH = ej.Measurement(
    TIME[ORDER], VALUE[:, ORDER, None], np.zeros(T, np.int32), PRESENT[ORDER, None]
)
SEEN = np.maximum.accumulate(np.where(PRESENT[ORDER], TIME[ORDER], 0))
TRUTH = PATH[np.clip(np.searchsorted(TIME, SEEN - 1e-9), 0, T - 1)]


def observed(step, context):
    del context
    return step.mean, step.cov, step.info


def filtered(estimator, params, runs=R):
    some = BATCH._replace(value=BATCH.value[:runs])
    found = ej.run_batch(estimator, params, some, prior=None, t0=0.0, observe=observed)
    return jax.tree.map(np.asarray, found)


@pytest.fixture(scope="module")
def members():
    """Mean (K, R, T, n), cov, Info of each EWIF."""
    single = ej.ewif(MODEL, lambda p: p["tau"])
    every = [filtered(single, {"r": PARAMS["r"], "tau": jnp.asarray(tau)}) for tau in TAUS]
    return jax.tree.map(lambda *x: np.stack(x), *every)


def test_a_bank_of_one_is_that_ewif(members):
    found = filtered(BANK, PARAMS | {"taus": jnp.asarray(TAUS[2:3])}, 3)
    wanted = jax.tree.map(lambda x: x[2, :3], members)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("forgetting", [1.0, 0.95])
def test_it_is_the_mixture_of_its_members(members, forgetting):
    params = PARAMS | {"forgetting": jnp.asarray(forgetting)}
    mean, cov, info = filtered(BANK, params)
    means, covs, infos = members
    told = infos.log_likelihood  # (K, R, T)
    weights = np.full(told.shape[:2], 1 / len(TAUS))
    wanted, likelihood, spread = np.zeros(mean.shape), np.zeros((R, T)), np.zeros(cov.shape)
    for k in range(T):
        if infos.status[0, 0, k] != ej.Status.MASKED:
            shared = forgetting * weights + (1 - forgetting) / len(TAUS)
            joint = shared * np.exp(told[:, :, k])
            likelihood[:, k] = np.log(joint.sum(0))
            weights = joint / joint.sum(0)
        own = means[:, :, k]
        wanted[:, k] = (weights[..., None] * own).sum(0)
        apart = own - wanted[:, k]
        both = covs[:, :, k] + apart[..., :, None] * apart[..., None, :]
        spread[:, k] = (weights[..., None, None] * both).sum(0)
    known = np.isfinite(means[0, 0, :, 0])
    np.testing.assert_allclose(mean[:, known], wanted[:, known], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(cov[:, known], spread[:, known], rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(info.log_likelihood[:, known], likelihood[:, known], atol=1e-8)
    assert not np.isfinite(mean[:, ~known]).any()
    assert (~known).sum() < 4


@pytest.mark.parametrize("forgetting", [1.0, 0.98])
def test_regret_is_within_its_bound(members, forgetting):
    params = PARAMS | {"forgetting": jnp.asarray(forgetting)}
    _, _, info = filtered(BANK, params)
    fixed = members[2].log_likelihood.sum(-1)  # (K, R)
    rows = int(PRESENT.sum())
    # Met exactly where one member has all the weight: up to rounding.
    bound = np.log(len(TAUS)) + (rows - 1) * np.log(1 / forgetting) + 1e-9
    assert np.all(info.log_likelihood.sum(-1) >= fixed.max(0) - bound)
    if forgetting < 1:
        # Slow, fast, slow: two switches, chosen afterwards.
        cut = np.searchsorted(TIME[ORDER], [20, 42])
        parts = np.split(members[2].log_likelihood, cut, axis=-1)
        switching = sum(part.sum(-1).max(0) for part in parts)
        bound = 3 * np.log(len(TAUS)) + 2 * np.log(1 / (1 - forgetting))
        bound += (rows - 3) * np.log(1 / forgetting)
        assert np.all(info.log_likelihood.sum(-1) >= switching - bound)


def test_it_follows_a_target_that_manoeuvres_better_than_the_best_single_tau(members):
    single = np.sqrt(((members[0][..., 0] - TRUTH) ** 2)[..., 5:].mean(-1))  # (K, R)
    best = single[np.argmin((single**2).mean(-1))]
    params = PARAMS | {"forgetting": jnp.asarray(0.98)}
    mean, _, _ = filtered(BANK, params)
    gain = best - np.sqrt(((mean[..., 0] - TRUTH) ** 2)[:, 5:].mean(-1))
    assert gain.mean() > 5 * gain.std(ddof=1) / np.sqrt(R)


def test_weights_sum_to_one_and_say_who_predicts_best():
    stream = jax.tree.map(lambda x: x[0] if x.ndim == 3 else x, BATCH)
    calm = jax.tree.map(lambda x: jnp.asarray(x[:60]), stream)
    trace = ej.run(BANK, PARAMS | {"forgetting": jnp.asarray(1.0)}, calm, prior=None, t0=0.0)
    weights = ej.bank_weights(trace.final_state)
    np.testing.assert_allclose(weights.sum(), 1.0, rtol=1e-12)
    assert np.argmax(weights) >= 3
    first = BANK.init(PARAMS, None, jnp.asarray(0.0))
    np.testing.assert_allclose(ej.bank_weights(first), 1 / len(TAUS), rtol=1e-12)
    with pytest.raises(ValueError, match="state: expected a state of `ewif_bank`"):
        ej.bank_weights(ej.ewif(MODEL, 1.0).init(PARAMS, None, 0.0))


def test_gradients_are_finite_and_equal_to_finite_differences():
    some = BATCH._replace(value=BATCH.value[:2, :60], time=BATCH.time[:60], mask=BATCH.mask[:60])
    some = some._replace(sensor=np.zeros(60, np.int32))
    loss = ej.likelihood_loss(BANK, some, prior=None, t0=0.0)
    both = jax.jit(lambda p: (jax.jacfwd(loss)(p), *jax.value_and_grad(loss)(p)))
    forward, _, reverse = both(PARAMS)
    for name in PARAMS:
        assert np.isfinite(forward[name]).all()
        np.testing.assert_allclose(forward[name], reverse[name], rtol=1e-7, atol=1e-11)
        ends = [
            both(PARAMS | {name: PARAMS[name] * jnp.exp(sign * 1e-5)})[1] for sign in (-1.0, 1.0)
        ]
        wanted = (ends[1] - ends[0]) / 2e-5
        found = (forward[name] * PARAMS[name]).sum()
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-8)


REFUSED = {
    "no tau": ((), 0.9, "taus: expected at least one"),
    "a negative tau": ((1.0, -1.0), 0.9, "taus: expected a positive"),
    "one number": (1.0, 0.9, r"taus: expected shape \(K"),
    "no memory": ((1.0,), 0.0, r"forgetting: expected a number in \(0, 1\]"),
    "more than all": ((1.0,), 1.5, r"forgetting: expected a number in \(0, 1\]"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused(name):
    taus, forgetting, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        ej.ewif_bank(MODEL, np.asarray(taus), forgetting)
    params = PARAMS | {"taus": np.asarray(taus), "forgetting": forgetting}
    with pytest.raises(ValueError, match=message):
        BANK.init(params, None, jnp.asarray(0.0))
