"""A folder of results that appears whole or not at all, and never takes an earlier one's place
without a word."""

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from ewif_jax.lab import lock
from ewif_jax.lab.identity import source_fingerprint
from ewif_jax.lab.pieces import (
    Arrays,
    Broken,
    digest_of_file,
    is_half,
    read_piece,
    write_piece,
    write_whole,
)
from ewif_jax.study.shared import manifest
from ewif_jax.study.shared.refusal import Refused, stop_if_asked

PROBE = bytes(1 << 18)
"""what a disk must have room for before any work begins"""


class Folder:
    """`out/name`, built in `out/name.partial/<fingerprint of the settings>`.

    Work that was interrupted is picked up by the next run with the same settings and the same
    source code; other settings have a partial folder of their own. One process at a time works in
    a partial folder.

    resumed, broken: pieces that were read back, and that had to be computed again because they
    were not whole; kept: files of an earlier result that this program did not write.
    """

    def __init__(self, out: Path, name: str, settings: Mapping[str, Any]) -> None:
        self.final = out / name
        self.settings = {**settings, "source": source_fingerprint()}
        text = json.dumps(self.settings, sort_keys=True, default=str)
        self.partial = out / f"{name}.partial" / hashlib.sha256(text.encode()).hexdigest()[:12]
        self.resumed: list[str] = []
        self.broken: list[str] = []
        self.kept: list[Path] = []
        self._written: set[str] = set()
        self._lock = self.partial.with_name(f"{self.partial.name}.lock")
        self._is_claimed = False

    def claim(self, overwrite: bool = False) -> None:
        """Finds before any work what would stop it at its end.

        Raises:
            Refused: another process works here, a link or a file has the name of the result, or
                with `overwrite` a folder that this program did not make.
            OSError: the folder cannot be written to, or the disk is full; with the path.
        """
        for path in (self.final, self.partial.parent, self.partial):
            if path.is_symlink() or (path.exists() and not path.is_dir()):
                kind = "a link" if path.is_symlink() else "a file"
                raise Refused(f"{path}: is {kind}, not a folder; move it or choose another --out")
        if overwrite and self.final.exists() and not manifest.is_ours(self.final):
            raise Refused(
                f"{self.final}: --overwrite replaces only what this program has made, and this "
                "folder has no list of such files (about.json); move it, or leave out --overwrite"
            )
        self._take()
        try:
            write_whole(self.partial / "room", lambda half: half.write_bytes(PROBE))
            (self.partial / "room").unlink()
        except BaseException:
            self.leave()
            raise

    def leave(self) -> None:
        """Gives the lock back; a partial folder stays if there is anything in it."""
        if self._is_claimed:
            _remove_if_empty(self.partial)
            lock.release(self._lock)
            _remove_if_empty(self.partial.parent)
        self._is_claimed = False

    def write(self, name: str, save: Callable[[Path], object]) -> None:
        """Lets `save` write a file of the results."""
        self._check()
        write_whole(self.partial / name, save)
        self._written.add(name)

    def piece(self, name: str, compute: Callable[[], Mapping[str, Any]]) -> Arrays:
        """The arrays of `compute()`, read back if an interrupted run has already computed them."""
        self._check()
        path = self.partial / f"piece-{name}.npz"
        if path.exists():
            try:
                arrays = read_piece(path)
            except Broken:
                self.broken.append(name)
            else:
                self.resumed.append(name)
                return arrays
        computed = dict(compute())
        self._check()
        write_piece(path, computed)
        return read_piece(path)

    def work(self, name: str) -> Path:
        """A folder for work of several parts, each of which is kept as soon as it is done (see
        `lab.compare`); it goes when the results are there."""
        self._check()
        return self.partial / f"work-{name}"

    def finish(self, about: Mapping[str, Any], overwrite: bool) -> Path | None:
        """Puts the results in their place; returns where an earlier result is kept, if any is.

        With `overwrite` the files of the earlier result go; what this program did not write stays:
        under its name among the new results, or where that is taken in the earlier folder.
        """
        self._check()
        missing = sorted(n for n in self._written if not (self.partial / n).is_file())
        if missing:
            raise Refused(f"{self.partial}: {', '.join(missing)} went missing; run it again")
        files = {name: digest_of_file(self.partial / name) for name in sorted(self._written)}
        text = manifest.sealed({**about, "files": files})
        self.write("about.json", lambda half: half.write_text(text, encoding="utf-8"))
        finishing = self.partial.with_name("finish.lock")
        lock.acquire(finishing, wait=True)
        try:
            earlier = self._swap()
        finally:
            lock.release(finishing)
        # only now: a crash before this line leaves them to resume from
        for path in [*self.final.glob("piece-*.npz"), *filter(is_half, self.final.iterdir())]:
            path.unlink()
        for path in self.final.glob("work-*"):
            shutil.rmtree(path)
        self.leave()
        if earlier is not None and overwrite:
            self.kept = manifest.clear(earlier, self.final)
        return earlier if earlier is not None and earlier.exists() else None

    def unfinished(self) -> bool:
        """Whether work with other settings waits in the partial folder."""
        parent = self.partial.parent
        return parent.is_dir() and any(path.is_dir() for path in parent.iterdir())

    def _swap(self) -> Path | None:
        """The partial folder takes the place of the earlier one, which takes a number."""
        if self.final.is_symlink() or not (self.final.is_dir() or not self.final.exists()):
            raise Refused(f"{self.final}: is not a folder; the results are in {self.partial}")
        earlier = None
        if self.final.exists():
            number = 1
            while os.path.lexists(earlier := self.final.with_name(f"{self.final.name}.{number}")):
                number += 1
            os.replace(self.final, earlier)
        try:
            os.replace(self.partial, self.final)
        except OSError:
            if earlier is not None:
                os.replace(earlier, self.final)
            raise
        return earlier

    def _check(self) -> None:
        """The partial folder is there and this process's own."""
        stop_if_asked()
        if not self._is_claimed:
            self._take()
        if not self.partial.is_dir():
            raise Refused(f"{self.partial}: another run has finished or removed it meanwhile")

    def _take(self) -> None:
        try:
            while True:
                self.partial.parent.mkdir(parents=True, exist_ok=True)
                # another process that finishes may remove the folder just then
                with suppress(FileNotFoundError):
                    lock.acquire(self._lock)
                    break
        except lock.Busy as owner:
            raise Refused(
                f"{self.partial}: another process ({owner}) works on the same study with the same "
                "settings; wait for it, or choose another --out"
            ) from None
        self.partial.mkdir(exist_ok=True)
        self._is_claimed = True


def _remove_if_empty(folder: Path) -> None:
    try:
        folder.rmdir()
    except FileNotFoundError:
        pass
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
