"""Files that are whole or are seen not to be."""

import hashlib
import io
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

Arrays = dict[str, np.ndarray]
DIGEST = hashlib.sha256().digest_size


class Broken(Exception):
    """The file is not what was written."""


def write_whole(path: Path, save: Callable[[Path], object]) -> None:
    """Lets `save` write a file, which takes its name once it is on the disk.

    Raises:
        OSError: with `path`; nothing is left under any name.
    """
    half = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        save(half)
        _flush_to_disk(half)
        os.replace(half, path)
        _flush_to_disk(path.parent)
    except BaseException as error:
        half.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OSError(error.errno, error.strerror or str(error), str(path)) from error
        raise


def is_half(path: Path) -> bool:
    """Whether a process that is gone left this file in the middle of `write_whole`."""
    dot, _, rest = path.name.partition(".")
    return dot == "" and rest.partition(".")[0].isdigit() and "." in rest


def write_piece(path: Path, arrays: Mapping[str, Any]) -> None:
    """Writes arrays (npz) with a digest of all bytes at the end."""
    buffer = io.BytesIO()
    named: Any = {key: np.asarray(value) for key, value in arrays.items()}
    np.savez(buffer, allow_pickle=False, **named)
    data = buffer.getvalue()
    write_whole(path, lambda half: half.write_bytes(data + hashlib.sha256(data).digest()))


def read_piece(path: Path) -> Arrays:
    """The arrays that `write_piece` wrote; only bytes with the right digest are looked into.

    Raises:
        Broken: it is not what was written.
    """
    data = path.read_bytes()
    body, digest = data[:-DIGEST], data[-DIGEST:]
    if hashlib.sha256(body).digest() != digest:
        raise Broken(path)
    with np.load(io.BytesIO(body), allow_pickle=False) as stored:
        return dict(stored)


def digest_of_file(path: Path) -> str:
    """Of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _flush_to_disk(path: Path) -> None:
    """Puts a file, or the names in a folder, on the disk."""
    if path.is_dir() and os.name == "nt":
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
