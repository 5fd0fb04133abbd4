"""Files that come from outside, or that must never be seen half written.

Reading is strict: plain JSON only (no NaN, no duplicate keys, bounded size and depth), and a path named
inside a file may not leave that file's folder. Writing goes through a temporary neighbour, fsync and rename.
"""

from __future__ import annotations

import json
import logging
import math
import os
import tempfile
from pathlib import Path
from typing import Any, NoReturn

from refield.scene.errors import InputError, expect

AnyPath = str | os.PathLike[str]
"""what a function takes wherever it wants a file or folder"""

MAX_JSON_BYTES = 64 * 1024 * 1024  # 10,000 frames are 10 MB; beyond this it is not a camera file


def as_path(path: AnyPath, what: str) -> Path:
    """A caller's argument, which ``what`` names, as a path.

    Raises:
        TypeError: it is no path.
    """
    expect(what, path, (str, os.PathLike), "a path, as text or as a pathlib.Path")
    return Path(path)


def log_warning(message: str) -> None:
    """The default of every ``warn`` argument: one line on stderr through the "refield" logger."""
    logging.getLogger("refield").warning(message)


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        InputError: missing, unreadable, too large, not JSON, NaN or Infinity, a key twice, nested too deeply,
            or not an object.
    """
    try:
        size = path.stat().st_size
        if size > MAX_JSON_BYTES:
            limit = f"the limit is {MAX_JSON_BYTES // 2**20} MB"
            raise InputError(path, f"the file has {size / 2**20:.0f} MB", f"{limit}; is it the right file?")
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "check the path and its permissions") from None
    except UnicodeDecodeError:
        raise InputError(path, "is not UTF-8 text", "save it as plain JSON") from None
    try:
        data = json.loads(text, parse_constant=_no_constant, parse_float=_finite_float, object_pairs_hook=_unique_keys)
    except RecursionError:
        raise InputError(path, "is nested too deeply to be a camera file", "check the file") from None
    except ValueError as error:
        raise InputError(path, f"is not valid JSON ({error})", "correct the file at that place") from None
    if not isinstance(data, dict):
        raise InputError(path, f"holds a {type(data).__name__} at the top", "an object {...} is expected")
    return data


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")


def _finite_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is out of range")
    return value


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    out = dict(pairs)
    if len(out) != len(pairs):
        seen: set[str] = set()
        twice = next(k for k, _ in pairs if k in seen or seen.add(k))  # type: ignore[func-returns-value]
        raise ValueError(f"the key {twice!r} is given twice")
    return out


def inside(root: Path, name: str, where: str) -> Path:
    """``root / name``, resolved, if it stays within ``root`` (symbolic links followed).

    Raises:
        InputError: the name is empty, or leads out of ``root``; ``where`` says who asked for it.
    """
    if not name or "\0" in name:
        raise InputError(where, f"{name!r} is not a file name", "give a path relative to the file's folder")
    try:
        path = (root / name).resolve()
    except (OSError, RuntimeError):  # a loop of links
        raise InputError(where, f"{name!r} cannot be resolved", "check the path and its links") from None
    if not path.is_relative_to(root.resolve()):
        raise InputError(
            where,
            f"{name!r} leads out of {root}",
            "use relative paths, with the images in that folder or below",
        )
    return path


def write_bytes(path: Path, data: bytes, *, durable: bool = True) -> None:
    """Replace ``path`` by ``data`` at once: a reader sees the old file or the whole new one.

    ``durable`` also waits for the disk, so that this holds after a power cut.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=".part-", dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            if durable:
                os.fsync(file.fileno())
        temporary.chmod(0o666 & ~umask())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Write an object as indented JSON, at once. NaN and Infinity raise ValueError."""
    write_bytes(path, (json.dumps(data, indent=1, allow_nan=False, ensure_ascii=False) + "\n").encode())


def umask() -> int:
    """The process's, for files that were made as temporary ones."""
    mask = os.umask(0)  # there is no way to read it without setting it
    os.umask(mask)
    return mask
