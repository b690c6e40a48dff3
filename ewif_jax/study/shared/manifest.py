"""Which files of a folder of results this program wrote: `about.json` lists them with digests."""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ewif_jax.lab.pieces import Broken, digest_of_file, read_piece

NAME = "about.json"


def sealed(about: Mapping[str, Any]) -> str:
    """The text of `about.json`: `about` and a digest of it, by which an edit is seen."""
    text = json.dumps(about, indent=2, default=str)
    return json.dumps({**json.loads(text), "seal": _seal_of(json.loads(text))}, indent=2) + "\n"


def is_ours(folder: Path) -> bool:
    """Whether this program made the folder. An empty one is anybody's."""
    return not any(folder.iterdir()) or _listed_digests(folder) is not None


def clear(earlier: Path, final: Path) -> list[Path]:
    """Deletes from the folder `earlier` what this program wrote into it, and the folder if nothing
    is left. Everything else is moved to `final` under its own name, or stays where that is taken.
    Returns where it is."""
    files = _listed_digests(earlier)
    if files is None:
        if earlier.is_dir() and not any(earlier.iterdir()):
            earlier.rmdir()
        return []
    kept = []
    for path in sorted(earlier.iterdir()):
        if _is_written(path, files):
            path.unlink()
        elif not os.path.lexists(final / path.name):
            os.replace(path, final / path.name)
            kept.append(final / path.name)
        else:
            kept.append(path)
    if not any(earlier.iterdir()):
        earlier.rmdir()
    return kept


def _listed_digests(folder: Path) -> dict[str, str] | None:
    """Digests by name; None if there is no list of ours."""
    try:
        about = json.loads((folder / NAME).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    if not isinstance(about, dict) or "seal" not in about:
        return None
    seal, files = about.pop("seal"), about.get("files")
    if not isinstance(files, dict):
        return None
    if seal == _seal_of(about):
        files = {**files, NAME: digest_of_file(folder / NAME)}
    return files


def _is_written(path: Path, files: Mapping[str, str]) -> bool:
    """Whether the file is as this program left it."""
    if path.is_symlink() or not path.is_file():
        return False
    if path.name.startswith("piece-") and path.suffix == ".npz":
        try:
            read_piece(path)
        except Broken:
            return False
        return True
    return path.name in files and digest_of_file(path) == files[path.name]


def _seal_of(about: Mapping[str, Any]) -> str:
    text = json.dumps(about, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
