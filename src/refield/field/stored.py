"""How any field is kept: tensors and facts in memory, ``field.safetensors`` and ``field.json`` in a folder."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from refield.field.encoding import Contraction
from refield.field.sampling import OccupancySampler
from refield.scene.errors import InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

FORMAT = 1
State = tuple[dict[str, Tensor], dict[str, Any]]
"""named tensors, and facts that JSON can hold"""
Kind = TypeVar("Kind")


def state_of(field: nn.Module, config: DataclassInstance, sampler: OccupancySampler) -> State:
    """Everything needed to rebuild a field, which is named by its class."""
    tensors = {k: v.detach().contiguous() for k, v in field.state_dict().items()}
    tensors |= sampler_out(sampler)
    space = sampler.contraction
    facts = {
        "architecture": type(field).__name__,
        "config": asdict(config),
        "contraction": {"centre": space.centre.tolist(), "radius": space.radius},
        "sampler": {k: getattr(sampler, k) for k in ("step", "near", "far", "per_step")},
    }
    return tensors, facts


def sampler_from(tensors: dict[str, Tensor], facts: dict[str, Any]) -> OccupancySampler:
    """The sampler in a state; its grid is taken out of ``tensors``."""
    space = Contraction(torch.tensor(facts["contraction"]["centre"]), facts["contraction"]["radius"])
    grid, fine = occupancy_in(tensors)
    return OccupancySampler(space, grid, **facts["sampler"], fine=fine)


def sampler_out(sampler: OccupancySampler) -> dict[str, Tensor]:
    """Where a sampler looks, as tensors: its grid, and the masks of the cells that are occupied."""
    tensors = {"occupancy": sampler.grid.contiguous()}
    if sampler.fine is not None:
        tensors["parts"] = sampler.fine[sampler.grid > 0]
    return tensors


def occupancy_in(tensors: dict[str, Tensor]) -> tuple[Tensor, Tensor | None]:
    """The grid and the masks of :func:`sampler_out`, which are taken out of ``tensors``; older files have no masks.

    Raises:
        KeyError, ValueError: there is no grid, or the masks are not those of its cells.
    """
    grid, parts = tensors.pop("occupancy"), tensors.pop("parts", None)
    if parts is None:
        return grid, None
    if parts.dtype != torch.int64 or parts.shape != (int((grid > 0).sum()),):
        raise ValueError("there is not a mask for each occupied cell")
    fine = torch.zeros(grid.shape, dtype=torch.int64)
    fine[grid > 0] = parts
    return grid, fine


def write_field(folder: Path, state: State) -> None:
    """Write ``field.safetensors`` and ``field.json`` into an existing folder."""
    tensors, facts = state
    save_file(tensors, str(folder / "field.safetensors"))
    (folder / "field.json").write_text(json.dumps({"format": FORMAT, **facts}, indent=1) + "\n")


def read_field(folder: Path, architecture: str, build: Callable[[dict[str, Tensor], dict[str, Any]], Kind]) -> Kind:
    """Inverse of :func:`write_field`. Raises InputError naming the folder whose files are missing or not ours."""
    try:
        facts = json.loads((folder / "field.json").read_text())
        if facts.get("format") != FORMAT:
            raise ValueError(f"format {facts.get('format')!r} is not {FORMAT}")
        if facts.get("architecture") != architecture:
            raise ValueError(f"a {facts.get('architecture')!r} is no {architecture}")
        return build(load_file(str(folder / "field.safetensors")), facts)
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, SafetensorError) as error:
        raise InputError(folder, f"holds no readable field ({error})", "train it again") from error
