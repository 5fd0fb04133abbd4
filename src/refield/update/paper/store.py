"""The paper's updated field as tensors and facts: helper, proposal networks, region. Old field and change lie
elsewhere."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import Any

from torch import Tensor

from refield.field.nerfacto import NerfactoField
from refield.field.radiance import Field
from refield.field.stored import State, occupancy_in, sampler_out
from refield.scene.change import SceneChange
from refield.update.paper.field import PaperField, base_of
from refield.update.paper.helper import HelperField
from refield.update.region import region_in, region_out


def paper_state(field: PaperField) -> State:
    """Everything that the update adds to the old field: named tensors, and facts that JSON can hold."""
    own, helper = field.helper.state()
    tensors = sampler_out(field.sampler) | region_out("region", field.region)
    tensors |= {f"helper.{name}": t for name, t in own.items()}
    tensors |= {f"proposals.{name}": t for name, t in field.proposals.state_dict().items()}
    return tensors, {"architecture": "PaperField", "regions": len(field.region.grids), "helper": helper}


def paper_from_state(
    tensors: dict[str, Tensor], facts: dict[str, Any], pretrained: Field, change: SceneChange
) -> PaperField:
    """Inverse of :func:`paper_state`, over the field and the change that it was made from.

    Raises:
        KeyError, TypeError, ValueError, RuntimeError: something is missing, or of another shape.
    """
    if not isinstance(pretrained, NerfactoField | PaperField):
        raise ValueError(f"the field before is a {type(pretrained).__name__}, not one of NeRFacto's shape")
    base = base_of(pretrained)
    helper = HelperField.from_state(_below("helper.", tensors), facts["helper"], base.contraction)
    proposals = deepcopy(base.proposals)
    proposals.load_state_dict(_below("proposals.", tensors))
    region = region_in("region", facts["regions"], tensors)
    grid, fine = occupancy_in(tensors)
    sampler = replace(pretrained.sampler, grid=grid, fine=fine)
    return PaperField(pretrained, change, helper, proposals.eval().requires_grad_(False), region, sampler=sampler)


def _below(name: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {key.removeprefix(name): t for key, t in tensors.items() if key.startswith(name)}
