"""The states a workspace has been in: state 0 is the fitted field, state N the field after visit N.

Every visit that changed something wraps the field before it; an updated field is a field.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from refield.artefacts import TENSORS
from refield.field.radiance import Field
from refield.field.render import render_many
from refield.scene.capture import Capture, Frame, camera_rays
from refield.scene.change import OccupancyGrid
from refield.scene.images import frame_image, write_image
from refield.update.composite import UpdatedField, layers_of, leaving
from refield.update.store import load_updated
from refield.workspace import Workspace

_SHOWS = 0.04
"""A rendered pixel that differs by more between two states shows what changed."""
_COARSE, _LEAST = 4, 96  # the comparison is made at a quarter of the photos' size, but no fewer pixels across


def changed_visits(workspace: Workspace, visit: int) -> list[int]:
    """The visits up to ``visit`` that changed the field."""
    return [n for n in range(1, visit + 1) if (workspace.visit(n) / TENSORS).is_file()]


def state(workspace: Workspace, visit: int) -> Field:
    """The field as it was after ``visit`` (0: before any).

    Raises:
        InputError: an artefact is missing or damaged.
    """
    field: Field = workspace.field()
    for number in changed_visits(workspace, visit):
        field = load_updated(workspace.visit(number), field, workspace.change(number))
    return field


def known_objects(now: Field) -> list[OccupancyGrid]:
    """What the visits that led to a field found out about things that can move, and where each stands in it."""
    if not isinstance(now, UpdatedField):
        return []
    known = known_objects(now.pretrained)
    for o in now.change.objects:
        centre = o.grid.tight_aabb().mean(0)
        known = [k for k in known if not bool(k.contains(centre))]
        if o.grid_now is not None:
            known.append(o.grid_now)
    return known


def retouched(capture: Capture, before: Field, now: Field, folder: Path) -> Capture:
    """The capture as if taken ``now``: where the photos show what has changed since, the field's own stand.

    The photos are from ``before``; an update must not learn from them what an earlier visit has put right. Each is
    written as a PNG into ``folder`` when it is first looked at: few are, where every object is known.
    """
    changed = _changed_boxes(now)
    if not changed:
        return capture

    def one(frame: Frame, name: str) -> Frame:
        return replace(frame, path=folder / name, made=partial(_retouch, frame, (before, now), changed))

    return replace(capture, frames=tuple(one(f, f"{i:04d}.png") for i, f in enumerate(capture.frames)))


def _retouch(frame: Frame, states: tuple[Field, Field], changed: Sequence[Tensor], path: Path) -> None:
    image = frame_image(frame).float() / 255
    mask = _differs(frame, *states, changed)
    if mask.any():
        rays = camera_rays(frame.camera, frame.world_from_cam)
        image[mask] = render_many(states[1], rays[mask.reshape(-1)]).rgb
    write_image(path, image)


def _differs(frame: Frame, before: Field, now: Field, changed: Sequence[Tensor]) -> Tensor:
    """(H, W) bool: where two states look different from a frame, with a margin of a coarse pixel.

    ``changed`` are world boxes (2, 3); only rays through them are compared.
    """
    camera = frame.camera
    part = min(max(1 / _COARSE, _LEAST / min(camera.width, camera.height)), 1.0)
    coarse = camera.shrunk(part)
    rays = camera_rays(coarse, frame.world_from_cam)
    near = torch.stack([leaving(rays, box) for box in changed]).amax(0) > 0
    mask = torch.zeros(1, 1, coarse.height, coarse.width)
    shown = [render_many(f, rays[near]).rgb for f in (before, now)]
    mask.view(-1)[near] = ((shown[0] - shown[1]).abs().amax(-1) > _SHOWS).float()
    mask = torch.nn.functional.max_pool2d(mask, 3, stride=1, padding=1)
    return torch.nn.functional.interpolate(mask, (camera.height, camera.width))[0, 0] > 0.5


def _changed_boxes(now: Field) -> list[Tensor]:
    """World boxes (2, 3) of everything that the visits that led to a field changed, light included."""
    boxes: list[Tensor] = []
    for update in layers_of(now):
        boxes += update.boxes + ((update.light.aabb,) if update.light is not None else ())
    return boxes


def untouched_psnr(fields: Sequence[Field], frames: Sequence[Frame], masks: Sequence[Tensor]) -> list[float]:
    """PSNR (dB) of each field over the pixels of ``frames`` that are in no mask, all frames pooled."""
    errors, count = [0.0] * len(fields), 0
    for frame, mask in zip(frames, masks):
        truth = frame_image(frame).reshape(-1, 3).float() / 255
        chosen = (~mask.reshape(-1)).nonzero()[:, 0]
        rays = camera_rays(frame.camera, frame.world_from_cam)[chosen]
        count += 3 * len(chosen)
        for k, field in enumerate(fields):
            errors[k] += float((render_many(field, rays).rgb - truth[chosen]).square().sum())
    return [float(-10 * torch.log10(torch.tensor(max(e / max(count, 1), 1e-12)))) for e in errors]
