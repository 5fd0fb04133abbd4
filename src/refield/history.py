"""The states a workspace has been in: state 0 is the fitted field, state N the field after visit N.

Every visit that changed something wraps the field before it; an updated field is a field.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from refield.artefacts import TENSORS
from refield.field.radiance import Field
from refield.field.render import render_many
from refield.field.source import Known
from refield.field.warp import crosses
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, Rays, camera_rays
from refield.scene.change import OccupancyGrid
from refield.scene.images import frame_image, scaled_image, write_image
from refield.update.composite import UpdatedField, layers_of, source_of
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
        field = load_updated(workspace.visit(number), field, workspace.change(number, masks=False))
    return field


def known_objects(now: Field) -> list[Known]:
    """What the visits that led to a field found out about things that can move, and where each stands in it."""
    return [Known(grid, source_of(now, grid)) for grid in _grids_now(now)]


def _grids_now(now: Field) -> list[OccupancyGrid]:
    """Of all objects that visits found, where they are."""
    known: list[OccupancyGrid] = []
    for update in reversed(list(layers_of(now))):
        objects = update.change.objects
        known = [k for k in known if not any(_holds_middle(k, o.grid) for o in objects)]
        for there in (o.grid_now for o in objects):
            # one that is known to stand there is the same: the visit took back the move that had led away from there
            if there is not None and not any(_holds_middle(k, there) for k in known):
                known.append(there)
    return known


def _holds_middle(grid: OccupancyGrid, other: OccupancyGrid) -> bool:
    return bool(grid.contains(other.tight_aabb().mean(0)))


def retouched(capture: Capture, now: Field, folder: Path) -> Capture:
    """The capture as if taken ``now``: where the photos show what has changed since, the field's own stand.

    The photos are from before any visit; an update must not learn from them what an earlier one has put right. Each is
    written as a PNG into ``folder`` when it is first looked at: few are, where every object is known.
    """
    updates = list(layers_of(now))
    shapes = tuple(box for update in updates for box in update.boxes)
    lights = tuple(u.light.aabb for u in updates if isinstance(u, UpdatedField) and u.light is not None)
    if not shapes and not lights:
        return capture
    before = updates[-1].pretrained

    def one(frame: Frame, name: str) -> Frame:
        # what is written is neutral already
        made = _Retouched(frame, before, now, shapes, lights)
        return replace(frame, path=folder / name, exposure=None, made=made)

    return replace(capture, frames=tuple(one(f, f"{i:04d}.png") for i, f in enumerate(capture.frames)))


@dataclass(frozen=True)
class _Retouched:
    """See `retouched`."""

    frame: Frame
    """as photographed"""
    before: Field
    now: Field
    shapes: tuple[Tensor, ...]
    """world boxes (2, 3) of everything that is not as it was"""
    lights: tuple[Tensor, ...]
    """and of where only the light changed"""

    def __call__(self, path: Path) -> None:
        frame = self.frame
        image = frame_image(frame).float() / 255
        part = min(max(1 / _COARSE, _LEAST / min(frame.camera.width, frame.camera.height)), 1.0)
        coarse = frame.camera.shrunk(part)
        rays = camera_rays(coarse, frame.world_from_cam)
        near = crosses(rays, self.shapes + self.lights).nonzero()[:, 0]
        was, now = torch.zeros(2, coarse.height, coarse.width, 3)
        for field, shown in ((self.before, was), (self.now, now)):
            shown.view(-1, 3)[near] = render_many(field, rays[near]).rgb
        mask = functional.interpolate(_differs(was, now)[None, None], image.shape[:2])[0, 0] > 0.5
        if mask.any():
            rays = camera_rays(frame.camera, frame.world_from_cam)
            image[mask] = render_many(self.now, rays[mask.reshape(-1)]).rgb
        write_image(path, image)

    def near(self, rays: Rays) -> Tensor:
        """See `Made`."""
        return crosses(rays, self.shapes)

    def at(self, camera: Camera, was: Tensor, now: Tensor) -> Tensor:
        """See `Made`."""
        image = scaled_image(self.frame, camera)
        # not a picture without error: what the field gets wrong in photos is learnt from these
        return torch.where(_differs(was, now)[..., None] > 0.5, (now + image - was).clamp(0, 1), image)


def _differs(was: Tensor, now: Tensor) -> Tensor:
    """(H, W) float32, 1 where two pictures (H, W, 3) look different, with a margin of a pixel."""
    mask = ((was - now).abs().amax(-1) > _SHOWS).float()
    return functional.max_pool2d(mask[None, None], 3, stride=1, padding=1)[0, 0]
