"""Compiled programs kept on disk, so that the next process need not compile them again."""

import os
import platform
import sys
from hashlib import blake2b
from pathlib import Path
from warnings import warn

import jax
import jaxlib.version

from ewif_jax import checks

CPUINFO = Path("/proc/cpuinfo")


def keep_programs(where: bool | str | os.PathLike[str]) -> None:
    """Turns on JAX's own cache of compiled programs: in the user's cache folder (True), or in a
    folder given. A folder that was chosen already (``JAX_COMPILATION_CACHE_DIR``, JAX's
    configuration) stays.

    Raises:
        OSError: a folder given that cannot be made or written in. The user's own is done without,
            with a warning.
    """
    if where is False:
        return
    ok = where is True or isinstance(where, str | os.PathLike)
    checks.require(ok, "cache", "True, False or a folder", checks.Shown(where))
    if chosen_folder():
        return
    folder = (_user_folder() if where is True else Path(where).expanduser()) / _machine_name()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK | os.X_OK):
            raise PermissionError(13, "cannot be written in", str(folder))
    except OSError as error:
        if where is not True:
            raise
        warn(f"compiled programs are not kept: {error}", stacklevel=3)
        return
    jax.config.update("jax_compilation_cache_dir", str(folder.absolute()))
    # Filters are many small programs, none of which takes the second that JAX asks for.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def chosen_folder() -> str | None:
    """Where JAX keeps programs already."""
    return jax.config.values["jax_compilation_cache_dir"]


def _user_folder() -> Path:
    """Where this system wants caches to be."""
    home = Path.home()
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or home / "AppData/Local") / "ewif_jax/Cache"
    if sys.platform == "darwin":
        return home / "Library/Caches/ewif_jax"
    chosen = os.environ.get("XDG_CACHE_HOME", "")
    # The XDG specification: a path that is not absolute counts as none.
    return (Path(chosen) if Path(chosen).is_absolute() else home / ".cache") / "ewif_jax"


def _machine_name() -> str:
    """A name for the kind of machine, whose programs another kind may not be able to run: a home
    folder may be shared by processors of several ages."""
    lines = CPUINFO.read_text().splitlines() if CPUINFO.exists() else []
    features = next((x for x in lines if x.startswith(("flags", "Features"))), "")
    named = f"{platform.machine()} {platform.processor()} {features}"
    digest = blake2b(named.encode(), digest_size=6).hexdigest()
    return f"jax-{jax.__version__}-{jaxlib.version.__version__}-{platform.machine()}-{digest}"
