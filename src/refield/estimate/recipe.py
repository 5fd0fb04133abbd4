"""estimate_change(): the steps of §4.2 in order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from refield.estimate import associate, detect, hull, light, look, objects, past, segment
from refield.estimate.associate import AssociateConfig
from refield.estimate.detect import Changed, DetectConfig
from refield.estimate.hull import Hull, HullConfig, Plane
from refield.estimate.lattice import Lattice, Voxels, components
from refield.estimate.look import Array, View
from refield.estimate.objects import ObjectConfig, Old
from refield.estimate.past import Past
from refield.estimate.pose_change import PoseChange, RefineConfig
from refield.estimate.register import RegisterConfig
from refield.field.radiance import Field
from refield.scene.capture import Capture, Frame
from refield.scene.change import ObjectChange, PlacedPhoto, SceneChange
from refield.scene.errors import InputError
from refield.vision import pixels

OnStage = Callable[[str], None]


@dataclass(frozen=True)
class EstimateConfig:
    """What changed? Every step's settings."""

    max_pixels: int = 24_000
    """photos are scaled down to this for everything but the refinement of poses"""
    survey: int = 10
    """old photos that the field's own errors are learnt from"""
    most_changed: float = 0.5
    """if more of the photos' pixels changed, they do not show this scene"""
    gone: float = 0.45
    """part of an object's pixels that must show what was behind it, for it to have left"""
    most_objects: int = 6
    """objects looked at, the largest first"""
    detect: DetectConfig = field(default_factory=DetectConfig)
    hull: HullConfig = field(default_factory=HullConfig)
    objects: ObjectConfig = field(default_factory=ObjectConfig)
    register: RegisterConfig = field(default_factory=RegisterConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    associate: AssociateConfig = field(default_factory=AssociateConfig)


@dataclass(frozen=True)
class _Scene:
    """What all steps after the first know."""

    capture: Capture
    field: Field
    config: EstimateConfig
    survey: tuple[View, ...]
    changed: tuple[Changed, ...]


def estimate_change(
    capture: Capture,
    field: Field,
    frames: Sequence[Frame],
    config: EstimateConfig = EstimateConfig(),
    on_stage: OnStage | None = None,
) -> SceneChange:
    """What moved, left or arrived between the capture that ``field`` was fitted to and a few new photos (§4.2).

    Args:
        frames: the new photos, with poses in the capture's world.
        on_stage: called with each step's name as it begins.

    Raises:
        InputError: most of the pixels changed: the photos show another scene.
    """
    say = on_stage or (lambda name: None)
    photos = tuple(PlacedPhoto(f.name, "used", frame=f) for f in frames)
    say("detect")
    scene = _detected(capture, field, frames, config)
    if not any(c.mask.any() for c in scene.changed):
        return SceneChange((), photos, "no pixel differs by more than the field's own errors on the old photos")
    say("hull")
    region = hull.find_region(scene.changed, config.hull)
    if region is None:
        return SceneChange((), photos, "the pixels that differ agree on no place in 3-D that more than one photo shows")
    carved, planes, free = _carved(scene, region)
    olds = _were_there(scene, carved, planes, free)
    say("pose")
    placed, rest, views = _placed(scene, olds, carved, planes, free)
    say("segment")
    return _concluded(scene, photos, (olds, placed, rest, views), carved)


def _detected(capture: Capture, field: Field, frames: Sequence[Frame], config: EstimateConfig) -> _Scene:
    views = [look.view_of(field, f, config.max_pixels) for f in frames]
    survey = [look.view_of(field, f, config.max_pixels) for f in look.spread_out(capture.frames, config.survey)]
    noise = detect.survey_noise(survey, config.detect)
    changed = detect.changes(views, noise, config.detect)
    share = float(np.mean([c.mask.mean() for c in changed]))
    if share > config.most_changed:
        what = f"{100 * share:.0f} % of the pixels changed; is this the same scene?"
        raise InputError("new photos", what, "give photos of the scene that was trained, with poses in its world")
    changed = light.set_light_aside(changed, config.detect)
    return _Scene(capture, field, config, tuple(n.view for n in noise), tuple(changed))


def _carved(scene: _Scene, region: Lattice) -> tuple[Hull, list[Plane], Voxels]:
    """The change hull, the planes that hold things up, and the voxels above them."""
    config = scene.config.hull
    old = [*scene.survey, *(c.view for c in scene.changed)]
    carved = hull.carve(region, [(c.view, c.mask) for c in scene.changed], old, config)
    points = np.concatenate([v.surface.reshape(-1, 3) for v in scene.survey])
    low, high = region.centres[0, 0, 0], region.centres[-1, -1, -1]
    pad = 0.3 * (high - low)
    points = points[np.isfinite(points).all(-1) & ((points > low - pad) & (points < high + pad)).all(-1)]
    points = points[np.random.default_rng(0).permutation(len(points))[:6000]]
    cameras = np.stack([v.centre for v in scene.survey])
    planes = hull.support_planes(points, cameras, region.cell) if len(points) >= 50 else []
    free = np.ones(region.shape, bool)
    for plane in planes:
        free &= plane.height(region.centres) > max(0.5 * region.cell, plane.noise)
    return carved, planes, free


def _were_there(scene: _Scene, carved: Hull, planes: Sequence[Plane], free: Voxels) -> list[Old]:
    """Objects of the old field that may have left their place: whole, and believed only if the photos see past them."""
    found: list[Old] = []
    smallest = scene.config.hull.smallest
    for part in components(carved.hull & carved.solid & free, smallest)[: scene.config.most_objects]:
        if any(old.lattice.holds(old.voxels, carved.lattice.centres[part]).mean() > 0.5 for old in found):
            continue
        old = objects.outline(
            scene.field, scene.capture.train, (carved.lattice, part), planes, scene.config.objects
        )
        if old is not None and past.silhouette_size(scene.changed, old) >= 12:
            found.append(old)
    return found


def _placed(
    scene: _Scene, olds: Sequence[Old], carved: Hull, planes: Sequence[Plane], free: Voxels
) -> tuple[dict[int, PoseChange], list[Voxels], list[Past]]:
    """Where the old objects are now, what arrived besides, and the photos with the objects taken off."""
    config = scene.config
    views = past.look_past(scene.field, scene.changed, scene.survey, olds, config.detect)
    gone = [k for k, old in enumerate(olds) if _left(views, old, config)]
    if len(gone) < len(olds):
        olds_gone = [olds[k] for k in gone]
        views = past.look_past(scene.field, scene.changed, scene.survey, olds_gone, config.detect)
    up = planes[0].normal if planes else _up(scene.capture)
    configs = (config.associate, config.register, config.refine)
    placed: dict[int, PoseChange] = {}
    tried: dict[tuple[int, int], tuple[float, PoseChange | None]] = {}
    while len(placed) < len(gone):
        now = associate.arrivals(carved, views, [olds[k] for k in gone], free, config.hull)
        parts = associate.newcomers(now, views, carved.lattice, config.hull)[: config.most_objects]
        targets = [associate.target_of(views, carved.lattice, p) for p in parts]
        if not targets:
            break
        fits = {}
        for k in gone:
            if k not in placed:
                fits[k] = associate.best_fit(
                    scene.field, olds[k], [olds[g] for g in gone], views, targets, up, configs
                )
        sure = {k: f for k, f in fits.items() if f[1] is not None}
        if not sure:
            break
        k = min(sure, key=lambda k: sure[k][0])
        change = sure[k][1]
        assert change is not None
        placed[k] = change
        views = associate.take_off(scene.field, views, olds[k], change)
    del tried
    left = {k: placed.get(k) for k in gone}
    now = associate.arrivals(carved, views, [olds[k] for k in gone], free, config.hull)
    rest = associate.newcomers(now, views, carved.lattice, config.hull)
    return left, rest, views  # type: ignore[return-value]


def _left(views: Sequence[Past], old: Old, config: EstimateConfig) -> bool:
    """Whether the photos show what was behind an object; where hardly anything behind it is known, yes."""
    share, asked = past.gone_score(views, old)
    total = sum(int(past.silhouette(p.view, old).sum()) for p in views)
    return share >= config.gone or asked < 0.12 * total


def _up(capture: Capture) -> Array:
    """The direction most cameras hold upwards."""
    down = np.stack([f.world_from_cam[:3, 1].numpy() for f in capture.frames]).mean(0)
    return (-down / max(float(np.linalg.norm(down)), 1e-9)).astype(np.float32)


def _concluded(
    scene: _Scene,
    photos: tuple[PlacedPhoto, ...],
    found: tuple[Sequence[Old], dict[int, PoseChange], list[Voxels], list[Past]],
    carved: Hull,
) -> SceneChange:
    olds, placed, rest, _ = found
    changes = []
    for k, change in placed.items():
        changes.append(_gone_or_moved(scene, olds[k], change))
    for part in rest:
        values = ndimage.gaussian_filter(ndimage.binary_fill_holes(part).astype(np.float32), 0.7)
        grid = carved.lattice.grid(values)
        masks = segment.masks_of(scene.field, scene.capture.train, grid, inside=False)
        changes.append(ObjectChange("added", grid, masks_in=masks))
    if not changes:
        why = "some pixels differ, but no object that left or arrived explains them better than the old field does"
        return SceneChange((), photos, why)
    counts = {k: sum(c.kind == k for c in changes) for k in ("moved", "removed", "added")}
    why = ", ".join(f"{n} {k}" for k, n in counts.items() if n)
    return SceneChange(tuple(changes), photos, why, *_pixel_masks(scene, found))


def _gone_or_moved(scene: _Scene, old: Old, change: PoseChange | None) -> ObjectChange:
    grid, frames = old.grid(), scene.capture.train
    masks = segment.masks_of(scene.field, frames, grid, inside=True)
    if change is None:
        return ObjectChange("removed", grid, masks=masks)
    moved = ObjectChange("moved", grid, change.new_from_old, masks)
    now = moved.grid_now
    assert now is not None
    masks_in = segment.masks_of(scene.field, frames, now, inside=False)
    return replace(
        moved, masks_in=masks_in, confidence=change.explained, covariance=change.covariance, note=change.note
    )


def _pixel_masks(
    scene: _Scene, found: tuple[Sequence[Old], dict[int, PoseChange], list[Voxels], list[Past]]
) -> tuple[tuple, tuple]:
    """Per new photo at its full size: changed pixels that show what is there now, and where something used to be."""
    import torch

    olds, placed, _, _ = found
    ins, outs = [], []
    for c in scene.changed:
        gone = np.zeros(c.view.shape, bool)
        for k in placed:
            gone |= past.silhouette(c.view, olds[k])
        size = (c.view.frame.camera.height, c.view.frame.camera.width)
        full = [ndimage.zoom(m.astype(np.uint8), np.array(size) / c.view.shape, order=0) > 0 for m in (c.mask, gone)]
        ins.append(torch.from_numpy(full[0]))
        outs.append(torch.from_numpy(pixels.dilate(full[1], 1)))
    return tuple(ins), tuple(outs)
