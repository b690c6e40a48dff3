"""One process at a time."""

import os
from pathlib import Path

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

_held: dict[Path, int] = {}
"""File descriptors of this process's locks: its own folders share them."""


class Busy(Exception):
    """Another process holds the lock; the text is its process id, as far as it is known."""


def acquire(path: Path, *, wait: bool = False) -> None:
    """Locks `path`, a file of its own that is created; the lock ends with the process, however it
    ends. What this process holds already is granted again.

    Raises:
        Busy: another process holds it, unless `wait`.
    """
    path = path.absolute()
    if path in _held:
        return
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            _lock_file(descriptor, wait)
        except BlockingIOError:
            owner = os.read(descriptor, 20).decode("ascii", "replace").strip()
            os.close(descriptor)
            raise Busy(owner or "unknown") from None
        except BaseException:
            os.close(descriptor)
            raise
        # The one who held it may have removed the file between opening and locking it here: a lock
        # on a file without a name keeps nobody out.
        if _is_same(descriptor, path):
            break
        os.close(descriptor)
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, str(os.getpid()).encode(), 0)
    _held[path] = descriptor


def release(path: Path) -> None:
    """Gives a lock of this process back and removes its file; nothing if it is not held."""
    descriptor = _held.pop(path.absolute(), None)
    if descriptor is not None:
        path.unlink(missing_ok=True)
        os.close(descriptor)


def _lock_file(descriptor: int, wait: bool) -> None:
    if fcntl is not None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


def _is_same(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
