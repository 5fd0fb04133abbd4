"""Whether a draw's changes are seen: small silhouettes from the cameras of a path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.capture import camera_rays
from refield.scene.pose import invert, rotate, transform
from refield.synthetic.random_scenes import Drawn
from refield.synthetic.state import Item, State, Triple
from refield.synthetic.visibility import view_hits

_WIDE = 40  # pixels, the longer side of the views that are tested
_SHOWN = 0.006  # of the picture: 98 pixels of 128 x 128
_CLEAR = 0.25  # of an object's outline, that must be in sight
_LARGEST = 0.3  # of the picture that an object may fill on the average
_BEFORE_LENS = 0.12  # of the distance to the target: nothing may be nearer
_BEFORE_TARGET = 0.7  # of the way to the target, that must be free
_OLD_SHARE = 0.35  # of the old views that must show a changed object
_PAINT, _OTHERWISE = 3.0, 0.15  # how much paint counts beside outline; what is needed of both
_KEPT_SHARE = 0.15  # ... and one that stays
_AROUND = 0.2  # of these, where old views look in all directions


@dataclass(frozen=True)
class Views:
    """Old, new and evaluation poses to test by."""

    camera: Camera
    old: list[Tensor]
    new: list[Tensor]
    evaluation: list[Tensor]
    distance: float
    target: Triple = (0.0, 0.0, 0.0)
    around: bool = False
    """whether the old ones look elsewhere too, in all directions"""

    @property
    def all(self) -> list[Tensor]:
        return [*self.old, *self.new, *self.evaluation]

    @property
    def small(self) -> Camera:
        return self.camera.shrunk(_WIDE / max(self.camera.width, self.camera.height))

    def depths(self, state: State) -> Tensor:
        """(V, H, W) along the rays, inf where nothing is."""
        return torch.stack([view_hits(state, self.small, pose).depth for pose in self.all])

    def clear(self, fixed: Tensor) -> bool:
        """Whether no camera stands in or close before something, and each has the target in sight."""
        there = fixed.isfinite().double().mean((1, 2))
        near = fixed.flatten(1).amin(1) > _BEFORE_LENS * self.distance
        asked = slice(len(self.old) if self.around else 0, None)
        sight = [self._in_sight(pose, depth) for pose, depth in zip(self.all[asked], fixed[asked])]
        return bool(near.all()) and all(sight) and bool((there > 0.3).double().mean() > 0.7)

    def _in_sight(self, pose: Tensor, depth: Tensor) -> bool:
        small, to = self.small, transform(invert(pose), torch.tensor([self.target], dtype=torch.float64))
        pixel, z = small.project(to)
        column, row = (int(v) for v in pixel[0].floor())
        inside = float(z) > 0 and 0 <= column < small.width and 0 <= row < small.height
        return inside and float(depth[row, column]) > _BEFORE_TARGET * float(to.norm())


def seen_by(views: Views, fixed: Tensor, drawn: Drawn) -> dict[str, dict[str, float]] | None:
    """Per object its shares of picture and outline; None where a change is not seen well enough.

    ``fixed`` (V, H, W) is the depth of all that stays.
    """
    depths = {item.name + when: _alone(views, item) for when, items in _both(drawn) for item in items}
    out: dict[str, dict[str, float]] = {}
    old, new = slice(0, len(views.old)), slice(len(views.old), len(views.old) + len(views.new))
    checks = slice(new.stop, None)
    for thing in drawn.things:
        name, changed = thing.item.name, drawn.kinds[thing.item.name] != "none"
        facts: dict[str, float] = {}
        for when, items in _both(drawn):
            if name + when not in depths:
                continue
            others = [depths[item.name + when] for item in items if item.name != name]
            shown, whole = _shares(depths[name + when], others, fixed)
            fine = (shown >= _SHOWN) & (shown >= _CLEAR * whole)
            looks = old if when == " before" else slice(new.start, None)
            enough = (_OLD_SHARE if changed else _KEPT_SHARE) * len(views.old) * (_AROUND if views.around else 1)
            if when == " before" and fine[old].sum() < enough:
                return None
            # both the old place and the new one are to be looked at by the new photos
            if changed and (fine[new].sum() < 2 or fine[checks].sum() < 1):
                return None
            if shown[looks].mean() > _LARGEST or shown.max() > 2 * _LARGEST:
                return None
            facts["picture_share" + when.replace(" ", "_")] = float(shown[looks].mean())
            facts["visible_share" + when.replace(" ", "_")] = float(
                shown[looks].sum() / whole[looks].sum().clamp_min(1e-9)
            )
        out[name] = facts
    pairs = [[{i.name: i for i in items}.get(name) for _, items in _both(drawn)] for name in drawn.changed]
    if not all(differs(views, old, new) for old, new in pairs if old is not None and new is not None):
        return None
    nearest = torch.stack(list(depths.values())).flatten(2).amin((0, 2))
    return out if bool((nearest > _BEFORE_LENS * views.distance).all()) else None


def differs(views: Views, old: Item, new: Item) -> bool:
    """Whether two of the new photos would show an object otherwise, by its outline or its paint."""
    changed = 0
    for pose in views.new:
        (there, was), (here, now) = (_painted(views, item, pose) for item in (old, new))
        both, either = there & here, there | here
        overlap = float(both.sum() / either.sum().clamp_min(1))
        paint = float((was - now).abs()[both].mean()) if bool(both.any()) else 0.0
        changed += bool(either.any()) and 1 - overlap + _PAINT * overlap * paint > _OTHERWISE
    return changed >= 2


def _painted(views: Views, item: Item, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Where an item alone is seen (H, W), and its texture there (H, W, 3)."""
    camera = views.small
    rays = camera_rays(camera, pose)
    item_from_world = invert(item.world_from_item)
    origins = transform(item_from_world, rays.origins.double())
    directions = rotate(item_from_world, rays.directions.double())
    t = item.solid.hit(origins, directions)
    there = t.isfinite()
    out = torch.zeros(len(t), 3)
    uv = item.solid.uv(origins[there] + t[there, None] * directions[there])
    height, width = item.texture.shape[:2]
    row, column = (uv[:, 1] * height).long().clamp(0, height - 1), (uv[:, 0] * width).long().clamp(0, width - 1)
    out[there] = torch.from_numpy(item.texture)[row, column]
    return there.reshape(camera.height, camera.width), out.reshape(camera.height, camera.width, 3)


def _both(drawn: Drawn) -> tuple[tuple[str, Sequence[Item]], tuple[str, Sequence[Item]]]:
    return (" before", drawn.before), (" after", drawn.after)


def _alone(views: Views, item: Item) -> Tensor:
    sky = np.zeros((1, 2, 3), np.float32)
    return views.depths(State((item,), sky))


def _shares(own: Tensor, others: list[Tensor], fixed: Tensor) -> tuple[Tensor, Tensor]:
    """Per view the share of the picture that an object fills, and would if it stood alone, (V,) each."""
    rest = torch.stack([fixed, *others]).amin(0)
    there = own.isfinite()
    return (there & (own <= rest)).double().mean((1, 2)), there.double().mean((1, 2))
