"""Bring a field up to date (§4.1): freeze, mask, fit a helper, show it where it knows better."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from refield.field.pixels import PixelBank
from refield.field.radiance import Field
from refield.field.render import render_many
from refield.field.sampling import OccupancySampler
from refield.scene.capture import Capture
from refield.scene.change import SceneChange
from refield.update.composite import UpdatedField
from refield.update.config import UpdateConfig
from refield.update.fit_helper import HelperTraining, Lit, UpdateProgress
from refield.update.frozen import composite_once
from refield.update.helper import new_helper, step_near
from refield.update.light import Relighting, Sightings, fit_light
from refield.update.region import Region, meets, move_out
from refield.update.supervision import Lessons, Places, changed_pixels, new_lessons, old_ring, places_of
from refield.vision.pixels import dilate

DEFAULTS = UpdateConfig()
_RING_RAYS = 40_000  # of the old photos; more add time and nothing to learn


def update_field(
    capture: Capture,
    field: Field,
    change: SceneChange,
    config: UpdateConfig = DEFAULTS,
    on_stage: Callable[[str], None] | None = None,
    on_progress: Callable[[UpdateProgress], None] | None = None,
) -> UpdatedField:
    """The field of the changed scene; ``field`` itself is not touched.

    ``capture`` holds the old photos, ``change`` what changed and the new photos; without new photos the old objects
    are cut out and the moved ones moved. ``on_stage`` hears the name of each stage as it begins.

    Raises:
        NonFiniteError: the helper's loss was not finite for 20 steps in a row.
    """
    say = on_stage or (lambda name: None)
    torch.manual_seed(config.seed)
    say("move")
    cut = UpdatedField(field, change)
    if not change.objects or not change.frames:
        return cut
    say("light")
    places = places_of(change)
    changed = [changed_pixels(change, places, i, f) for i, f in enumerate(change.frames)]
    sparse = new_lessons(change.frames, cut, changed)
    light = _light(sparse, field, change, changed) if config.relight else None
    say("supervise")
    wide = move_out(change, config.dilation)
    region = wide.sampler(step_near(field, wide.box.mean(0)))
    old = _old_lessons(capture, field, places, region, config, light)
    sparse = sparse[meets(region, sparse.rays).nonzero()[:, 0]]
    say("freeze")
    frozen = UpdatedField(field, change, region=wide, light=light)
    new_taught, judge = _split(Lit(sparse, composite_once(frozen, region, sparse.rays)), config.held_out)
    old_taught = Lit(old, composite_once(frozen, region, old.rays))
    say("train")
    helper = new_helper(region, change.frames, config.seed)
    run = HelperTraining(helper, change, new_taught, old_taught, judge, config)
    run.run(on_progress)
    say("show")
    helper.eval().requires_grad_(False)
    updated = UpdatedField(field, change, helper, region=move_out(change, config.shown), light=light)
    updated.why_stopped = run.why_stopped
    return updated


def _split(lit: Lit, every: int) -> tuple[Lit, Lit]:
    """What may be drawn, and every so-many-th ray to judge by."""
    index = torch.arange(len(lit.lessons))
    kept = (index % every) == every // 2
    parts = [(~kept).nonzero()[:, 0], kept.nonzero()[:, 0]]
    taught, judge = (Lit(lit.lessons[p], lit.fixed[p]) for p in parts)
    return taught, judge


def _light(sparse: Lessons, field: Field, change: SceneChange, changed: list[np.ndarray]) -> Relighting | None:
    """The light on what did not change, from the new photos' pixels that show it."""
    still = torch.cat([torch.from_numpy(~dilate(c, math.ceil(0.01 * c.shape[1]))).reshape(-1) for c in changed])
    seen = sparse[still.nonzero()[:, 0]]
    was = render_many(field, seen.rays)
    x = seen.rays.origins + seen.rays.directions * was.depth[:, None]
    solid = (was.opacity > 0.9).nonzero()[:, 0]
    box = Region(tuple(g for o in change.objects for g in (o.grid, o.grid_now) if g is not None)).box
    side = max(float((o.grid.tight_aabb().diff(dim=0)).max()) for o in change.objects)
    box = torch.stack([box[0] - 1.5 * side, box[1] + 1.5 * side])
    pixel = min(float((f.centre.float() - box.mean(0)).norm()) / f.camera.fx for f in change.frames)
    return fit_light(Sightings(x, seen.rgb, was.rgb, seen.photo)[solid], box, 1.5 * pixel)


def _old_lessons(
    capture: Capture,
    field: Field,
    places: Places,
    region: OccupancySampler,
    config: UpdateConfig,
    light: Relighting | None,
) -> Lessons:
    """Ring pixels of the old photos whose rays meet the region, in the new light."""
    bank = PixelBank(capture.train)
    chosen = []
    for i, frame in enumerate(capture.train):
        ring = old_ring(places, i, frame, config.shadow, config.far)
        if ring is not None:
            chosen.append(ring.reshape(-1).nonzero()[:, 0] + bank.starts[i])
    pixels = torch.cat(chosen) if chosen else torch.zeros(0, dtype=torch.long)
    pixels = pixels[meets(region, bank.rays(pixels)).nonzero()[:, 0]]
    pixels = pixels[torch.randperm(len(pixels))[:_RING_RAYS]].sort().values
    rays, rgb = bank.rays(pixels), bank.colours(pixels)
    if light is not None:
        was = render_many(field, rays)
        rgb = light.applied(rays.origins + rays.directions * was.depth[:, None], rgb)
    return Lessons(rays, rgb, torch.full((len(rgb),), -1))
