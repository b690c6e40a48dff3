"""A filter taken over from FilterPy, dynamax or pykalman is that library's own filter, to 1e-9."""

import pickle
import warnings
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ewif_jax as ej
from ewif_jax.lab import adapters

T = 20


def drawn(seed: int, *, noise: float = 0.1) -> SimpleNamespace:
    """A random stable model of 2 to 4 states seen by 1 to 2 numbers, and its data."""
    rng = np.random.default_rng(seed)
    n, m = 2 + seed % 3, 1 + seed % 2
    F = rng.normal(size=(n, n))
    F *= 0.95 / np.abs(np.linalg.eigvals(F)).max()

    def cov(size: int, floor: float) -> np.ndarray:
        root = rng.normal(size=(size, size))
        return root @ root.T + floor * np.eye(size)

    return SimpleNamespace(
        n=n, m=m, F=F, H=rng.normal(size=(m, n)), Q=cov(n, 0.1), R=cov(m, noise), P=cov(n, 0.1),
        mean=rng.normal(size=n), B=rng.normal(size=(n, 2)), u=rng.normal(size=(T, 2)),
        b=rng.normal(size=n), d=rng.normal(size=m), z=5 * rng.normal(size=(T, m)),
    )  # fmt: skip


def of_filterpy(world, alpha=1.0):
    filterpy = pytest.importorskip("filterpy.kalman")
    kf = filterpy.KalmanFilter(dim_x=world.n, dim_z=world.m, dim_u=2)
    kf.x, kf.P = world.mean[:, None].copy(), world.P.copy()
    kf.F, kf.H, kf.Q, kf.R, kf.B, kf.alpha = world.F, world.H, world.Q, world.R, world.B, alpha
    return kf


def filtered(adapted, values):
    stream = ej.stream(adapted.times(len(values)), values)
    return ej.run(adapted.estimator, None, stream, prior=adapted.prior, t0=adapted.t0)


def close(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("seed", "alpha"), [(0, 1.0), (1, 1.0), (2, 1.1), (3, 1.02)])
def test_filterpy_with_inputs_and_missing_data(seed, alpha):
    world = drawn(seed)
    values = world.z.copy()
    values[[3, 7, 8, 9]] = np.nan
    kf = of_filterpy(world, alpha)
    trace = filtered(adapters.from_filterpy(kf, dt=0.25, u=world.u), values)
    for k, value in enumerate(values):
        kf.predict(world.u[k][:, None])
        kf.update(None if np.isnan(value).any() else value[:, None])
        close(trace.mean[k], kf.x[:, 0])
        close(trace.cov[k], kf.P)
        if not np.isnan(value).any():
            close(trace.info.log_likelihood[k], kf.log_likelihood)
            close(trace.info.innovation_cov[k], kf.S)


def test_filterpy_as_it_stands_in_the_middle_of_its_data_with_x_of_one_axis():
    world = drawn(1)
    kf = of_filterpy(world)
    kf.x, kf.B = world.mean.copy(), None
    for value in world.z[:5]:
        kf.predict()
        kf.update(value)
    trace = filtered(adapters.from_filterpy(kf), world.z[5:])
    for value in world.z[5:]:
        kf.predict()
        kf.update(value)
    close(trace.mean[-1], kf.x)
    close(trace.cov[-1], kf.P)


def test_filterpys_filter_takes_late_data_that_it_did_not():
    world = drawn(0)
    kf = of_filterpy(world)
    adapted = adapters.from_filterpy(kf)
    order = np.array([0, 1, 3, 4, 2, 5])
    late = ej.replay(adapted.estimator, 4)
    stream = ej.stream(adapted.times(6)[order], world.z[order])
    trace = ej.run(late, None, stream, prior=adapted.prior, t0=adapted.t0)
    asd = ej.run(ej.asd(adapted.model, 4), None, stream, prior=adapted.prior, t0=adapted.t0)
    for value in world.z[:6]:
        kf.predict()
        kf.update(value[:, None])
    for found in (trace, asd):
        close(found.mean[-1], kf.x[:, 0])
        close(found.cov[-1], kf.P)


def of_dynamax(world):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what it imports
        inference = pytest.importorskip("dynamax.linear_gaussian_ssm.inference")
    params = inference.ParamsLGSSM(
        initial=inference.ParamsLGSSMInitial(mean=world.mean, cov=world.P),
        dynamics=inference.ParamsLGSSMDynamics(
            weights=world.F, bias=world.b, input_weights=world.B, cov=world.Q
        ),
        emissions=inference.ParamsLGSSMEmissions(
            weights=world.H, bias=world.d, input_weights=np.zeros((world.m, 2)), cov=world.R
        ),
    )
    return inference, jax.tree.map(jnp.asarray, params)


@pytest.mark.parametrize("seed", range(3))
def test_dynamax_with_inputs_and_biases(seed):
    # Its 1e-9 on the diagonal of S shall be little beside S.
    world = drawn(seed, noise=100.0)
    inference, params = of_dynamax(world)
    theirs = inference.lgssm_filter(params, jnp.asarray(world.z), jnp.asarray(world.u))
    trace = filtered(adapters.from_dynamax(params, u=world.u), world.z)
    close(trace.mean, theirs.filtered_means)
    close(trace.cov, theirs.filtered_covariances)
    close(trace.info.log_likelihood.sum(), theirs.marginal_loglik)


@pytest.mark.parametrize("seed", range(3))
def test_pykalman_with_offsets_and_missing_data(seed):
    pykalman = pytest.importorskip("pykalman")
    world = drawn(seed)
    values = world.z.copy()
    values[[4, 5, 11]] = np.nan
    kf = pykalman.KalmanFilter(
        world.F, world.H, world.Q, world.R, world.b, world.d, world.mean, world.P
    )
    masked = np.ma.masked_invalid(values)
    means, covs = kf.filter(masked)
    trace = filtered(adapters.from_pykalman(kf), values)
    close(trace.mean, means)
    close(trace.cov, covs)
    close(trace.info.log_likelihood.sum(), kf.loglikelihood(masked))


def lgssm(world, **changes):
    """What dynamax calls `ParamsLGSSM`, by its attributes alone."""
    parts = {
        "initial": {"mean": world.mean, "cov": world.P},
        "dynamics": {"weights": world.F, "bias": world.b, "cov": world.Q, "input_weights": world.B},
        "emissions": {"weights": world.H, "bias": world.d, "cov": world.R, "input_weights": None},
    }
    for name, value in changes.items():
        part, field = name.split("_", 1)
        parts[part] |= {field: value}
    return SimpleNamespace(**{part: SimpleNamespace(**own) for part, own in parts.items()})


def test_an_offset_of_the_emissions_is_taken_off_the_data():
    """Against the plain filter of z - d, in float64 and float32, and for late data."""
    world = drawn(1)
    shifted, plain = (
        adapters.from_dynamax(lgssm(world, emissions_bias=d)) for d in (world.d, None)
    )
    order = np.array([0, 2, 1, 3])
    for dtype, tolerance in ((np.float64, 1e-12), (np.float32, 1e-5)):
        found = []
        for adapted, z in ((shifted, world.z), (plain, world.z - world.d)):
            stream = ej.stream(adapted.times(4)[order].astype(dtype), z[order].astype(dtype))
            method = ej.al1(adapted.model, 3)
            found.append(ej.run(method, None, stream, prior=adapted.prior, t0=adapted.t0).mean)
        assert found[0].dtype == dtype
        np.testing.assert_allclose(found[0], found[1], rtol=tolerance, atol=tolerance)
    assert np.abs(world.d).max() > 0.1


def test_variances_of_emissions_in_a_vector_are_the_diagonal():
    world = drawn(1)
    diagonal = np.array([0.5, 2.0])
    vector, matrix = (
        adapters.from_dynamax(lgssm(world, emissions_cov=R)) for R in (diagonal, np.diag(diagonal))
    )
    assert vector.model == matrix.model
    again = pickle.loads(pickle.dumps(matrix))
    assert again.estimator == matrix.estimator


def without(name: str) -> SimpleNamespace:
    """A FilterPy filter that lacks an attribute."""
    kf = SimpleNamespace(x=np.zeros(2), P=np.eye(2), F=np.eye(2), Q=np.eye(2), H=np.eye(2), R=1.0)
    kf.R = np.eye(2)
    delattr(kf, name)
    return kf


@pytest.mark.parametrize("name", ["x", "P", "F", "Q", "H", "R"])
def test_an_attribute_that_is_missing_is_named(name):
    with pytest.raises(ValueError, match=rf"^kf: .*'{name}'.*SimpleNamespace"):
        adapters.from_filterpy(without(name))


WORLD = drawn(1)
REFUSED = {
    "dynamics.weights: .*constant.*function": {"dynamics_weights": lambda t: WORLD.F},
    r"dynamics.weights: .*varies in time.*\(20, 3, 3\)": {"dynamics_weights": np.ones((T, 3, 3))},
    "emissions.cov: .*shape": {"emissions_cov": np.eye(3)},
    "dynamics.bias: .*shape": {"dynamics_bias": np.ones((T, 3))},
    "initial.mean: .*finite": {"initial_mean": np.array([0.0, np.nan, 1.0])},
    "emissions.input_weights: .*zeros": {"emissions_input_weights": np.ones((2, 2))},
    "dynamics.input_weights: .*matrix": {"dynamics_input_weights": None},
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_cannot_be_carried_over_is_refused_by_name(message):
    with pytest.raises(ValueError, match=message):
        adapters.from_dynamax(lgssm(WORLD, **REFUSED[message]), u=WORLD.u)


def test_filterpys_other_filters_and_settings_are_refused_by_name():
    filterpy = pytest.importorskip("filterpy.kalman")
    with pytest.raises(ValueError, match=r"'H'.*ExtendedKalmanFilter"):
        adapters.from_filterpy(filterpy.ExtendedKalmanFilter(2, 1))
    crossed, scalar = of_filterpy(drawn(1)), of_filterpy(drawn(1))
    crossed.M[0, 0], scalar.R = 0.1, 5.0
    with pytest.raises(ValueError, match=r"kf\.M: .*cross correlation"):
        adapters.from_filterpy(crossed)
    with pytest.raises(ValueError, match=r"kf\.R: expected shape \(2, 2\)"):
        adapters.from_filterpy(scalar)
    without_B = of_filterpy(drawn(1))
    without_B.B = None
    with pytest.raises(ValueError, match=r"kf\.B: .*None"):
        adapters.from_filterpy(without_B, u=np.ones((3, 2)))


def test_pykalman_lists_are_refused_by_name():
    kf = SimpleNamespace(n_dim_state=2, n_dim_obs=1, transition_matrices=np.ones((T, 2, 2)))
    with pytest.raises(ValueError, match=r"kf\.transition_matrices: .*varies in time"):
        adapters.from_pykalman(kf)
    kf.transition_matrices = None
    with pytest.raises(ValueError, match="observation_matrices"):
        adapters.from_pykalman(kf)
