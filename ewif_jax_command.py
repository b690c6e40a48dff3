"""The command `ewif-jax` before its imports, which take seconds: outside of the package, because
importing any part of that imports all of it."""

import os
import signal
import sys
from pathlib import Path
from types import FrameType


def main() -> None:
    """Entry point: answers at once where that is possible, and to Ctrl-C; else it is
    `ewif_jax.study.cli.main`."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), _stop)
    match sys.argv[1:]:
        case ["track", file, *_] if not file.startswith("-") and not Path(file).exists():
            print(f"ewif-jax: {file}: no such file", file=sys.stderr)
            raise SystemExit(2)
    from ewif_jax.study.cli import main as work

    work()


def _stop(number: int, frame: FrameType | None) -> None:
    """Nothing has begun: there is nothing to leave in order, and an exception in the middle of an
    import can get lost."""
    del frame
    os.write(2, b"ewif-jax: stopped before it began\n")
    os._exit(128 + number)
