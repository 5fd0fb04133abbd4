"""An updated field's own part on disk: helper, region, light, sampler. Old field and change lie elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from refield.artefacts import read_tensors, write_tensors
from refield.field.radiance import Field, HashField
from refield.field.stored import occupancy_in, sampler_out
from refield.scene.change import SceneChange
from refield.scene.errors import InputError
from refield.update.composite import UpdatedField
from refield.update.learnt import Earlier, Learnt, Origin
from refield.update.light import Relighting
from refield.update.paper.field import PaperField
from refield.update.paper.store import paper_from_state, paper_state
from refield.update.recall import ground_of, without
from refield.update.region import region_in, region_out
from refield.update.textured import TexturedPlane

_REMEDY = "restore the visit, or remove it and update again"


def save_updated(folder: Path, field: UpdatedField | PaperField) -> None:
    """Write ``field.safetensors`` and ``field.json``.

    Raises:
        TypeError: the helper is no `HashField`, so there is no file for it.
    """
    if isinstance(field, PaperField):
        return write_tensors(folder, *paper_state(field))
    tensors: dict[str, Tensor] = sampler_out(field.sampler)
    facts: dict[str, Any] = {
        "architecture": "UpdatedField",
        "regions": len(field.region.grids),
        "bare": len(field.bare.grids),
        "helper": None,
    }
    tensors |= region_out("region", field.region) | region_out("bare", field.bare)
    facts["planes"] = len(field.region.planes)
    for i, plane in enumerate(field.region.planes):
        tensors |= _plane_out(f"plane.{i}", plane)
    for name, known in (("places", field.earlier.places), ("unknown", field.earlier.unknown)):
        tensors |= region_out(name, known)
        facts[name] = len(known.grids)
    facts["undone"] = [[o.object, o.layer, o.index] for o in field.earlier.undone]
    facts["left"] = [[o.object, o.layer, o.index] for o in field.earlier.left]
    tensors["unseen"] = field.unseen
    if field.eyes is not None:
        tensors["eyes"] = field.eyes
    facts["shading"] = len(field.shading)
    tensors |= _light_out("light", field.light)
    for i, light in enumerate(field.shading):
        tensors |= _light_out(f"shading.{i}", light)
    if field.helper is not None:
        if not isinstance(field.helper, HashField):
            raise TypeError(f"a helper of type {type(field.helper).__name__} cannot be saved")
        own, facts["helper"] = field.helper.state()
        tensors |= {f"helper.{name}": tensor for name, tensor in own.items()}
    write_tensors(folder, tensors, facts)


def load_updated(folder: Path, pretrained: Field, change: SceneChange) -> UpdatedField | PaperField:
    """The updated field that `save_updated` wrote, over the field and the change that it was made from.

    Moves that it took back are taken back again.

    Raises:
        InputError: a file is missing, damaged, or of another shape.
    """
    tensors, facts = read_tensors(folder)
    try:
        if facts["architecture"] == "PaperField":
            return paper_from_state(tensors, facts, pretrained, change)
        region = region_in("region", facts["regions"], tensors)
        planes = tuple(
            _plane_in(f"plane.{i}", tensors) for i in range(facts.get("planes", 0))
        )  # older visits have none
        region = replace(region, planes=planes)
        bare = region_in("bare", facts["bare"], tensors)
        light = _light_in("light", tensors)
        shading = tuple(_light_in(f"shading.{i}", tensors) for i in range(facts["shading"]))
        own = {name.removeprefix("helper."): t for name, t in tensors.items() if name.startswith("helper.")}
        helper = HashField.from_state(own, facts["helper"]) if facts["helper"] is not None else None
        unseen = tensors.get("unseen", torch.zeros(0, dtype=torch.long))  # of older visits it is not known
        if unseen.dtype != torch.long or not bool(((unseen >= 0) & (unseen < pretrained.sampler.grid.numel())).all()):
            raise ValueError("a cell that is not shown is not one of the grid's")
        grid, fine = occupancy_in(tensors)
        sampler = replace(pretrained.sampler, grid=grid, fine=fine)
        base, earlier = _earlier_in(tensors, facts, pretrained)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(folder, f"does not describe an updated field ({error})", _REMEDY) from None
    learnt = Learnt(helper, region, light, shading, bare)
    eyes = tensors.get("eyes")
    return UpdatedField(base, change, learnt, eyes=eyes, earlier=earlier, sampler=sampler).unshown(unseen)


def _earlier_in(tensors: dict[str, Tensor], facts: dict[str, Any], field: Field) -> tuple[Field, Earlier]:
    """What the update took from earlier visits, and ``field`` without the moves that it took back."""
    undone, left = (tuple(Origin(*map(int, o)) for o in facts.get(name, ())) for name in ("undone", "left"))
    for origin in undone:
        field = without(field, origin, departed=False)
    places, unknown = (region_in(name, facts.get(name, 0), tensors) for name in ("places", "unknown"))
    return field, Earlier(undone, left, places, ground_of(field, left), unknown)


def _plane_out(name: str, plane: TexturedPlane) -> dict[str, Tensor]:
    sizes = torch.tensor([plane.texel, plane.depth, plane.clear], dtype=torch.float64)
    parts = {"normal": plane.normal, "origin": plane.origin, "axes": plane.axes, "rgb": plane.rgb, "known": plane.known}
    return {f"{name}.{key}": part for key, part in (parts | {"sizes": sizes}).items()}


def _plane_in(name: str, tensors: dict[str, Tensor]) -> TexturedPlane:
    normal, origin, axes, rgb, known = (
        tensors[f"{name}.{key}"] for key in ("normal", "origin", "axes", "rgb", "known")
    )
    texel, depth, clear = tensors[f"{name}.sizes"].tolist()
    return TexturedPlane(normal, origin, axes, texel, depth, clear, rgb, known)


def _light_out(name: str, light: Relighting | None) -> dict[str, Tensor]:
    return {} if light is None else {f"{name}.aabb": light.aabb, f"{name}.log_gain": light.log_gain}


def _light_in(name: str, tensors: dict[str, Tensor]) -> Relighting | None:
    aabb = tensors.get(f"{name}.aabb")
    return None if aabb is None else Relighting(aabb, tensors[f"{name}.log_gain"])
