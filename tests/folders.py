"""What a folder holds, to see that nothing was touched."""

import hashlib
from pathlib import Path


def contents(folder: Path) -> dict[str, str]:
    """Every file's path below ``folder`` and its bytes' hash; empty folders count, lock files and caches do not."""
    out = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if ".photos" in path.parts:
            continue
        if path.is_file() and path.name != ".lock":
            out[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        elif path.is_dir() and not any(path.iterdir()) and path.name != "visits":
            out[name] = "empty"
    return out
