"""A folder of results that appears whole or not at all, and never takes an earlier one's place
without a word."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

PACKAGE = Path(__file__).parents[2]
Arrays = dict[str, np.ndarray]


class Folder:
    """`out/name`, built in `out/name.partial/<fingerprint of the settings>`.

    Work that was interrupted is picked up by the next run with the same settings and the same
    source code; other settings have a partial folder of their own.
    """

    def __init__(self, out: Path, name: str, settings: Mapping[str, Any]) -> None:
        self.final = out / name
        self.settings = {**settings, "source": source_fingerprint()}
        text = json.dumps(self.settings, sort_keys=True, default=str)
        self.partial = out / f"{name}.partial" / hashlib.sha256(text.encode()).hexdigest()[:12]
        self.resumed: list[str] = []

    def write(self, name: str, save: Callable[[Path], object]) -> None:
        """Lets `save` write a file of the results."""
        self.partial.mkdir(parents=True, exist_ok=True)
        path = self.partial / name
        half = path.with_name(f".{os.getpid()}.{path.name}")
        save(half)
        os.replace(half, path)

    def piece(self, name: str, compute: Callable[[], Mapping[str, Any]]) -> Arrays:
        """The arrays of `compute()`, read back if an interrupted run has already computed them."""
        path = self.partial / f"piece-{name}.npz"
        if path.exists():
            self.resumed.append(name)
            with np.load(path, allow_pickle=False) as stored:
                return dict(stored)
        arrays = {key: np.asarray(value) for key, value in compute().items()}
        self.write(path.name, lambda half: _save_npz(half, arrays))
        return arrays

    def finish(self, about: Mapping[str, Any], overwrite: bool) -> Path | None:
        """Puts the results in their place; returns where an earlier result is kept, if any is."""
        text = json.dumps(about, indent=2, default=str) + "\n"
        self.write("about.json", lambda half: half.write_text(text, encoding="utf-8"))
        for path in self.partial.glob("piece-*.npz"):
            path.unlink()
        for path in self.partial.glob(".*"):
            path.unlink()
        earlier = self._set_aside() if self.final.exists() else None
        os.replace(self.partial, self.final)
        if not any(self.partial.parent.iterdir()):
            self.partial.parent.rmdir()
        if earlier is not None and overwrite:
            shutil.rmtree(earlier)
            return None
        return earlier

    def _set_aside(self) -> Path:
        number = 1
        while (aside := self.final.with_name(f"{self.final.name}.{number}")).exists():
            number += 1
        os.replace(self.final, aside)
        return aside


def source_fingerprint() -> str:
    """A digest of the package's source code."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


def _save_npz(path: Path, arrays: Arrays) -> None:
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)
