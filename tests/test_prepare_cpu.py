"""`prepare_cpu` changes how fast filters are, and no number."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from apart import FLAGS_OF_THE_TESTS, soon_fast

import ewif_jax as ej
from ewif_jax.fast import cache, compiling
from ewif_jax.fast.cache import keep_programs

CHILD = """
import resource
import sys
import jax
import jax.numpy as jnp
import numpy as np
import ewif_jax as ej

if sys.argv[2] == "prepared":
    ej.prepare_cpu(devices=2)
    jax.devices()
    ej.prepare_cpu(devices=2)  # asking twice is no mistake
jax.config.update("jax_enable_x64", True)

model = ej.models.constant_acceleration(sensors=ej.models.position_sensor(0.3), q=lambda p: p["q"])
time = jnp.asarray([0.1, 0.2, 0.45, 0.3, 0.7, 0.71, 0.9])  # one is late
values = jnp.sin(time + jnp.arange(4.0)[:, None])
prior = ej.Gaussian(jnp.zeros(3), jnp.eye(3))
filters = {"ewif": ej.ewif(model, lambda p: p["tau"]), "al1": ej.al1(model, 3)}
params, stream, found = {"tau": 1.0, "q": 0.2}, ej.stream(time, values[0]), {}
batch = jax.vmap(lambda v: ej.stream(time, v))(values)
def squares(params):
    return jnp.sum(ej.run(filters["al1"], params, stream, prior=prior, t0=0.0).mean ** 2)
for name, estimator in filters.items():
    trace = ej.run(estimator, params, stream, prior=prior, t0=0.0)
    batched = ej.run_batch(estimator, params, batch, prior=prior, t0=0.0)
    found |= {f"{name} mean": trace.mean, f"{name} cov": trace.cov, f"{name} batch": batched.mean}
found["slope"] = jax.jit(jax.grad(squares))(params)["q"]
error = ej.rmse_loss(filters["ewif"], batch, values[..., None], prior=prior, t0=0.0)
program = jax.jit(jax.value_and_grad(error)).lower({"tau": jnp.asarray(1.0)}).compile()
found["loss and gradient"] = jnp.stack([x["tau"] if isinstance(x, dict) else x
                                        for x in program({"tau": jnp.asarray(1.0)})])
found["waits"] = "all-reduce" in program.as_text()
found["spread"] = len(batched.mean.devices())
program = jax.jit(lambda x: jax.lax.scan(lambda c, _: (jnp.sin(c) + 1, c), x, None, length=99)[1])
text = program.lower(jnp.ones(300)).compile().as_text()
found["whole"] = "xla_cpu_small_call" in text
found["devices"] = len(jax.devices())

# The loop over groups is short, and several threads take part in it: as one function it would fail.
plane = ej.models.position_sensor(0.3, dims=2)
plane = ej.models.constant_velocity(sensors=plane, q=0.2, dims=2)
time = jnp.arange(300.0)
long = ej.Measurement(time, jnp.cos(time[:, None] + jnp.arange(256.0).reshape(128, 1, 2)),
                      jnp.zeros(300, int), jnp.ones((300, 2), bool))
found["long"] = ej.run_batch(ej.kalman(plane), None, long, t0=0.0, devices=1,
                             prior=ej.Gaussian(jnp.zeros(4), jnp.eye(4)),
                             observe=lambda step, _: step.mean.sum())

large = jax.jit(lambda x: x + 1)
arrays = [jnp.zeros(5_000_000)]
for k in range(40):
    if k == 30:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    arrays.append(jax.block_until_ready(large(arrays.pop())))
found["page faults"] = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
np.savez(sys.argv[1], **found)
"""


def numbers(file, how):
    flags = soon_fast(os.environ.get(FLAGS_OF_THE_TESTS, ""))
    environment = {**os.environ, "XLA_FLAGS": flags}
    command = [sys.executable, "-c", CHILD, str(file), how]
    subprocess.run(command, env=environment, check=True)
    return dict(np.load(file))


def test_loops_become_one_function_and_cores_devices_and_no_number_changes(tmp_path):
    plain = numbers(tmp_path / "plain.npz", "plain")
    prepared = numbers(tmp_path / "prepared.npz", "prepared")
    assert (plain.pop("whole"), prepared.pop("whole")) == (False, True)
    assert (plain.pop("devices"), prepared.pop("devices")) == (1, 2)
    assert (plain.pop("spread"), prepared.pop("spread")) == (1, 2)
    before, after = plain.pop("page faults"), prepared.pop("page faults")
    if platform.libc_ver()[0] == "glibc":
        assert after < before / 2
    # A loss over several devices would add up what each has, and their threads wait for each other.
    assert not plain.pop("waits")
    assert not prepared.pop("waits")
    for name, expected in plain.items():
        np.testing.assert_allclose(prepared[name], expected, rtol=1e-10, atol=1e-12, err_msg=name)


KEPT = """
import sys
import warnings
import jax
import jax.numpy as jnp
from jax._src import monitoring
import ewif_jax as ej
from ewif_jax.fast import cache

ej.prepare_cpu(1, cache={"": True}.get(sys.argv[1], sys.argv[1]))
read = []
monitoring.register_event_listener(lambda name, **_: read.append(name))
model = ej.models.random_walk(sensors=ej.models.position_sensor(1.0), q=0.5)
prior = ej.Gaussian(jnp.zeros(1), jnp.eye(1))
rows = ej.stream([1.0, 2.0], [0.5, 0.7])
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    mean = ej.run(ej.kalman(model), None, rows, prior=prior, t0=0.0).mean
hits = sum(name.endswith("cache_hits") for name in read)
print(jax.config.jax_compilation_cache_dir, hits, float(mean[-1, 0]), len(told), sep=chr(10))
"""


def kept(folder, home, **environment):
    """The cache folder, programs read from it, an estimate, and warnings, of a process."""
    system = {"HOME": str(home), "XDG_CACHE_HOME": str(home / "caches")}
    without = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", KEPT, str(folder)],
        env={**without, **system, **environment},
        check=True,
        capture_output=True,
        text=True,
    )
    place, hits, mean, told = done.stdout.split()[-4:]
    return place, int(hits), float(mean), int(told)


def test_programs_are_kept_for_the_next_process(tmp_path):
    place, none, mean, _ = kept("", tmp_path)
    folder = tmp_path / "caches" / "ewif_jax"
    assert Path(place).parent == folder
    assert none == 0
    files = program_files(place)
    _, hits, same, _ = kept("", tmp_path)
    assert hits > 5
    assert same == mean
    assert program_files(place) == files
    # Other options of the compiler make other programs.
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_enable_fast_min_max=true"
    assert kept("", tmp_path, XLA_FLAGS=flags)[1] == 0
    # A file that a process left half written is compiled again, with a warning.
    for file in program_files(place):
        file.write_bytes(file.read_bytes()[:100])
    _, hits, again, told = kept("", tmp_path)
    assert (hits, again) == (0, mean)
    assert told > 0


def program_files(place):
    return set(Path(place).glob("*-cache"))


def test_the_folder_is_the_users_or_the_one_given_or_the_one_chosen_before(tmp_path, monkeypatch):
    chosen = {}
    monkeypatch.setattr(jax.config, "update", chosen.__setitem__)
    monkeypatch.setattr(cache, "chosen_folder", lambda: None)
    keep_programs(False)
    assert not chosen
    keep_programs(tmp_path / "mine")
    place = Path(chosen.pop("jax_compilation_cache_dir"))
    assert place.parent == tmp_path / "mine"
    monkeypatch.setattr(cache, "CPUINFO", tmp_path / "other")
    (tmp_path / "other").write_text("flags : of another processor\n")
    keep_programs(tmp_path / "mine")
    assert chosen.pop("jax_compilation_cache_dir") != str(place)
    monkeypatch.setattr(cache, "chosen_folder", lambda: "before")
    chosen.clear()
    keep_programs(True)
    assert not chosen


def test_a_folder_that_cannot_be_is_refused_or_done_without(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "chosen_folder", lambda: None)
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(OSError, match="file"):
        keep_programs(file)
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))
    with pytest.warns(UserWarning, match=r"not kept.*file"):
        keep_programs(True)
    with pytest.raises(ValueError, match="cache: expected True, False or a folder"):
        keep_programs(3)


def test_too_late_and_bad_sizes_are_refused():
    jax.devices()
    with pytest.raises(RuntimeError, match="before"):
        ej.prepare_cpu(devices=2)
    with pytest.raises(ValueError, match=r"devices.*whole number >= 1.*0"):
        ej.prepare_cpu(devices=0)


def test_options_of_the_user_stay(monkeypatch):
    monkeypatch.setattr(jax.config, "update", lambda name, value: None)
    monkeypatch.setattr(compiling, "_keep_memory", lambda: None)  # this process has other tests
    mine = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=7"
    monkeypatch.setenv("XLA_FLAGS", mine)
    ej.prepare_cpu()
    assert os.environ["XLA_FLAGS"] == mine
    monkeypatch.setenv("XLA_FLAGS", "--xla_dump_to=somewhere")
    ej.prepare_cpu()
    assert os.environ["XLA_FLAGS"].startswith("--xla_dump_to=somewhere --xla_backend_extra_options")
