"""A checkpoint's tensors by name, read by torch's weights-only unpickler.

Beside the weights nerfstudio keeps the states of optimisers and schedules. Their learning rates are numpy scalars,
which that unpickler refuses; here they become nothing at all, so that numpy's own constructors stay out of it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import torch
from torch import Tensor

from refield.scene.errors import InputError

_KINDS = ("Float64", "Float32", "Float16", "Int64", "Int32", "Bool")
_NUMPY = (
    *(f"numpy.{c}.multiarray.{f}" for c in ("core", "_core") for f in ("scalar", "_reconstruct")),
    "numpy.dtype",
    "numpy.ndarray",
    *(f"numpy.dtypes.{kind}DType" for kind in _KINDS),
)
_AGAIN = "train with nerfstudio's own ns-train, or copy the file anew"


class _Nothing:
    """Stands where a numpy scalar stood."""

    def __init__(self, *arguments: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        pass


def read_model(path: Path) -> dict[str, Tensor]:
    """The model's tensors by their names within it, from a checkpoint of nerfstudio's trainer.

    Raises:
        InputError: it is none, is damaged, or holds objects that could run code.
    """
    if not is_zipfile(path):
        raise InputError(path, "is not a checkpoint of torch", _AGAIN)
    try:
        with torch.serialization.safe_globals([(_Nothing, name) for name in _NUMPY]):
            told = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except MemoryError:
        raise
    except Exception as error:  # torch raises whatever a damaged file leads it to
        what = f"cannot be read as weights alone ({str(error).splitlines()[0]})"
        raise InputError(path, what, _AGAIN) from None
    pipeline: Any = told.get("pipeline") if isinstance(told, dict) else None
    if not isinstance(pipeline, dict):
        raise InputError(path, "holds no state of a pipeline", _AGAIN)
    names = {name: name.removeprefix("module.") for name in pipeline if isinstance(name, str)}
    prefix = "_model."
    found = {n.removeprefix(prefix): pipeline[k] for k, n in names.items() if n.startswith(prefix)}
    found = {name: tensor for name, tensor in found.items() if isinstance(tensor, Tensor)}
    if not any(name.startswith("field.") for name in found):
        raise InputError(path, "holds no weights of a field", _AGAIN)
    return found
