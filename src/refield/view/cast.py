"""What the browser draws of a state: points within a second, splats when they are ready; these are kept.

Splats of a state take as long as an export. They lie in ``WORK/.view``, named by what the state is made of, so that
none is ever out of date; the folder may be deleted.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from refield.artefacts import FACTS
from refield.estimate.look import spread_out
from refield.export.seen import ends_of, views_of
from refield.export.splats import WIDE, Splats, splats_of
from refield.export.surface import cells_of, mean_over, surface_of
from refield.field.radiance import Field
from refield.history import changed_visits
from refield.scene.capture import Frame
from refield.scene.files import write_bytes
from refield.workspace import VIEWED, Workspace

SPLATS = 60_000
"""of a state, at most, and those of its far dome: a browser without a graphics card turns no more in bearable time"""
_GLIMPSE_VIEWS, _GLIMPSE_RAYS = 16, 60_000
_DOME = 6_000  # splats on a whole sphere around the scene: what is far off is blurred here
_WIDER = 1.35  # times as wide as those of an export, which are more: no gap between them
_VIEW_RAYS = 1_200_000  # that the splats' surface is looked for along

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Cloud:
    """P points of a state."""

    xyz: Tensor
    """(P, 3) float32, world"""
    rgb: Tensor
    """(P, 3) float32 in [0, 1]"""
    apart: Tensor
    """(P,) float32: how far from each other they lie there, world units"""

    def thinned(self, part: float) -> Cloud:
        """About this part of the points, each in place of all that were around it."""
        if part == 1:
            return self
        cells = cells_of(self.xyz, self.apart / math.sqrt(part))
        area = torch.zeros(int(cells.max()) + 1).index_add_(0, cells, self.apart**2)
        return Cloud(mean_over(self.xyz, cells), mean_over(self.rgb, cells), area.sqrt())


def glimpse_of(field: Field, frames: Sequence[Frame]) -> Cloud:
    """What some of the photos' places show, quickly found: some points may float."""
    views = views_of(field, spread_out(frames, _GLIMPSE_VIEWS), rays=_GLIMPSE_RAYS)
    xyz, _, footprint, rgb = (torch.cat(part) for part in zip(*map(ends_of, views)))
    return Cloud(xyz, rgb, footprint)


def cloud_of(splats: Splats) -> Cloud:
    """Points in the splats' places, which are drawn much quicker."""
    return Cloud(splats.means, splats.rgb, splats.scales[:, 0] / (WIDE * _WIDER))


def splats_for(
    field: Field, frames: Sequence[Frame], most: int = SPLATS, on_progress: Progress | None = None
) -> Splats:
    """A state as splats, as an export has it, but fewer."""
    views = views_of(field, frames, on_progress, rays=_VIEW_RAYS)
    splats = splats_of(surface_of(field, views, most), views, min(_DOME, most // 8))
    return replace(splats, scales=splats.scales * _WIDER)


def name_of_state(workspace: Workspace, visit: int, most: int = SPLATS) -> str:
    """A name that two states share only if the same files make them."""
    folders = [workspace.path / "field", *(workspace.visit(n) for n in changed_visits(workspace, visit))]
    told = b"".join(hashlib.sha256((folder / FACTS).read_bytes()).digest() for folder in folders)
    return f"{hashlib.sha256(told).hexdigest()[:24]}-{most}"


def kept_splats(workspace: Workspace, name: str) -> Splats | None:
    """Those kept under a name; None if there are none that can be read."""
    path = _path(workspace, name)
    try:
        tensors = load(path.read_bytes())
        return Splats(**{f.name: tensors[f.name] for f in fields(Splats)})
    except (OSError, SafetensorError, KeyError):
        return None


def keep_splats(workspace: Workspace, name: str, splats: Splats, others: Sequence[str]) -> None:
    """Keep them, and forget those of states that are neither this nor among ``others``. Where nothing can be written
    they are not kept."""
    path = _path(workspace, name)
    with contextlib.suppress(OSError):
        path.parent.mkdir(exist_ok=True)
        write_bytes(path, save({f.name: getattr(splats, f.name).contiguous() for f in fields(Splats)}))
        for stale in path.parent.glob("*.safetensors"):
            if stale.stem not in (name, *others):
                stale.unlink()


def _path(workspace: Workspace, name: str) -> Path:
    return workspace.path / VIEWED / f"{name}.safetensors"
