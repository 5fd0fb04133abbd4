"""Artefacts that appear whole: locked folders, folders built aside and renamed, tensors with a checksum."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from torch import Tensor

from refield.scene.errors import InputError
from refield.scene.files import read_json, write_bytes, write_json

TENSORS, FACTS = "field.safetensors", "field.json"
PART = ".part-"
LOCK = ".lock"


def write_tensors(folder: Path, tensors: dict[str, Tensor], facts: dict[str, Any]) -> None:
    """``field.safetensors`` with the tensors and ``field.json`` with the facts and the tensors' checksum."""
    from safetensors.torch import save

    data = save({k: v.detach().cpu().contiguous() for k, v in tensors.items()})
    write_bytes(folder / TENSORS, data)
    write_json(folder / FACTS, facts | {"sha256": hashlib.sha256(data).hexdigest()})


def read_tensors(folder: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """What `write_tensors` wrote.

    Raises:
        InputError: a file is missing, is no safetensors file, or is not the one that was written.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    facts, path = read_json(folder / FACTS), folder / TENSORS
    try:
        data = path.read_bytes()
        if hashlib.sha256(data).hexdigest() != facts.pop("sha256", None):
            raise InputError(path, "is damaged: field.json has another checksum", "restore it or train again")
        return load(data), facts
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "restore it or train again") from None
    except (SafetensorError, ValueError) as error:
        raise InputError(path, f"is not a safetensors file ({error})", "restore it or train again") from None


@contextlib.contextmanager
def writable(path: Path) -> Iterator[None]:
    """What the disk refuses becomes one clear line."""
    try:
        yield
    except OSError as error:
        what = f"cannot be written ({error.strerror})"
        raise InputError(path, what, "check permissions and free space") from None


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a folder's lock, so that one process at a time writes.

    Raises:
        InputError: another process holds it, or the folder cannot be written.
    """
    with writable(folder):
        handle = (folder / LOCK).open("w")
    with handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            what = "is being written by another refield"
            raise InputError(folder, what, "wait until it has ended, then try again") from None
        yield


@contextlib.contextmanager
def part_folder(base: Path) -> Iterator[Path]:
    """A hidden folder in ``base``, removed at the end whatever happens (unless renamed). Call under the lock:
    what an earlier run that was killed left behind is cleared away."""
    for stale in base.glob(f"{PART}*"):
        shutil.rmtree(stale, ignore_errors=True)
    with writable(base):
        part = Path(tempfile.mkdtemp(prefix=PART, dir=base))
        part.chmod(0o755)
    try:
        yield part
    finally:
        shutil.rmtree(part, ignore_errors=True)


def need_writable(path: Path) -> None:
    """Check that a file or folder can be made, or replaced, at ``path``.

    Raises:
        InputError: the folder that it would lie in, or the first above it that is there, cannot be written.
    """
    there = next(p for p in (path, *path.parents) if p.is_dir() or (p != path and p.exists()))
    if not there.is_dir():
        raise InputError(path, f"cannot be made: {there} is a file, not a folder", "choose another place")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(path, f"cannot be written: {there} allows no writing", "check permissions, or choose another")


def need_space(folder: Path, size: int) -> None:
    """Check that ``size`` bytes fit on the disk, with some to spare.

    Raises:
        InputError: they do not.
    """
    free = shutil.disk_usage(folder).free
    if free < size * 1.1 + 50e6:
        what = f"{size / 1e6:.0f} MB of photos do not fit into the {free / 1e6:.0f} MB that are free"
        raise InputError(folder, what, "free some space, or choose another disk")


def sync(folder: Path) -> None:
    """Bring every file below ``folder`` to the disk before its name becomes visible."""
    for root, _, files in os.walk(folder):
        for name in files:
            descriptor = os.open(Path(root, name), os.O_RDONLY)
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
        sync_folder(Path(root))


def sync_folder(folder: Path) -> None:
    """Bring a folder's own entries (names) to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
