"""Where finished units of work are kept: in memory, or in a folder of one study alone."""

import errno
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from ewif_jax.lab import lock
from ewif_jax.lab.pieces import Arrays, Broken, is_half, read_piece, write_piece, write_whole

ABOUT, UNITS, LOCK = "about.json", "units", ".lock"
KIND = "ewif_jax.lab.compare"
PROBE = bytes(1 << 18)
"""What a disk must have room for before any work begins."""


class Store(Protocol):
    """Arrays by name, kept as soon as they are there."""

    def has(self, name: str) -> bool:
        """Whether they are there and whole."""
        ...

    def read(self, name: str) -> Arrays:
        """Them."""
        ...

    def write(self, name: str, arrays: Mapping[str, Any]) -> None:
        """Keeps them."""
        ...


class InMemory:
    """A store that ends with the process."""

    def __init__(self) -> None:
        self._kept: dict[str, Arrays] = {}

    def has(self, name: str) -> bool:
        """Whether they are there."""
        return name in self._kept

    def read(self, name: str) -> Arrays:
        """The arrays of that name."""
        return self._kept[name]

    def write(self, name: str, arrays: Mapping[str, Any]) -> None:
        """Keeps them."""
        self._kept[name] = dict(arrays)


class InFolder:
    """A store in `folder/units`, one file for each name, each whole or not there.

    `folder/about.json` says what the study is made of: the same study goes on where it was
    interrupted; a folder that anything else has made is refused.
    """

    def __init__(self, folder: str | os.PathLike[str], about: Mapping[str, Any]) -> None:
        self.folder = Path(folder)
        self.about = json.loads(json.dumps({"made by": KIND, **about}, default=str))
        self.resumed = 0
        self.broken: list[str] = []
        self._checked: set[str] = set()

    def claim(self, need: int) -> None:
        """Finds before any work what would stop it at its end.

        Args:
            need: bytes that the results will take at most.

        Raises:
            ValueError: another study or program made the folder.
            RuntimeError: another process works in it.
            OSError: it cannot be written to, or there is not room enough; with the path.
        """
        self._refuse_strangers()
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(self.folder / LOCK)
        except lock.Busy as owner:
            raise RuntimeError(
                f"folder: {self.folder} is being filled by another process ({owner}); wait for it, "
                "or choose another folder"
            ) from None
        try:
            self._refuse_strangers()
            self._prepare(need)
        except BaseException:
            self.leave()
            raise

    def _prepare(self, need: int) -> None:
        units = self.folder / UNITS
        if not (self.folder / ABOUT).exists():
            text = json.dumps(self.about, indent=2) + "\n"
            write_whole(self.folder / ABOUT, lambda half: half.write_text(text, encoding="utf-8"))
        units.mkdir(exist_ok=True)
        for path in (*self.folder.iterdir(), *units.iterdir()):
            if is_half(path):
                path.unlink()
        self.resumed = sum(1 for path in units.glob("*.npz"))
        # A disk that is full or read-only says so now, not after hours of work.
        write_whole(units / "room", lambda half: half.write_bytes(PROBE))
        (units / "room").unlink()
        kept = sum(path.stat().st_size for path in units.glob("*.npz"))
        free = shutil.disk_usage(units).free
        if need - kept > free:
            text = f"the results may take {need / 1e6:.0f} MB, and {free / 1e6:.0f} MB are free"
            raise OSError(errno.ENOSPC, text, str(self.folder))

    def leave(self) -> None:
        """Lets other processes in."""
        lock.release(self.folder / LOCK)

    def _refuse_strangers(self) -> None:
        folder = self.folder
        if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
            kind = "a link" if folder.is_symlink() else "a file"
            raise ValueError(f"folder: expected a folder, got {folder}, which is {kind}")
        names = [] if not folder.exists() else os.listdir(folder)
        if all(name == LOCK or is_half(folder / name) for name in names):
            return  # new, or claimed by a process that ended before it wrote anything
        try:
            there = json.loads((folder / ABOUT).read_text(encoding="utf-8"))
        except (FileNotFoundError, ValueError):
            there = None
        if not isinstance(there, dict) or there.get("made by") != KIND:
            raise ValueError(
                f"folder: expected a new or empty folder, or one of this study, got {folder}, "
                f"which has files of something else ({', '.join(sorted(names)[:3])})"
            )
        names = [*there, *(name for name in self.about if name not in there)]
        other = [name for name in names if there.get(name) != self.about.get(name)]
        if other:
            told = "; ".join(f"{n}: {there.get(n)} there, {self.about.get(n)} here" for n in other)
            raise ValueError(
                f"folder: expected a new folder, or one of the same study, got {folder} with other "
                f"settings or code ({told}). Results are never mixed: choose another folder, or "
                "delete this one"
            )

    def has(self, name: str) -> bool:
        """Whether they are there and whole."""
        if name in self._checked:
            return True
        try:
            read_piece(self._path(name))
        except FileNotFoundError:
            return False
        except Broken:
            self.broken.append(name)
            return False
        self._checked.add(name)
        return True

    def read(self, name: str) -> Arrays:
        """The arrays of that name."""
        return read_piece(self._path(name))

    def write(self, name: str, arrays: Mapping[str, Any]) -> None:
        """Keeps them; they are on the disk when this returns."""
        write_piece(self._path(name), arrays)
        self._checked.add(name)

    def _path(self, name: str) -> Path:
        return self.folder / UNITS / f"{name}.npz"
