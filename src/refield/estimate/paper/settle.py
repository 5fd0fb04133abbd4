"""What happened to each object, and what that makes of it in 3-D (§4.2.3 and §4.2.4, object by object)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from refield.estimate.detect import Mask
from refield.estimate.look import Array, View
from refield.estimate.models import Models
from refield.estimate.paper import segment
from refield.estimate.paper.associate import Partners, Sighting, Thing
from refield.estimate.paper.config import PaperConfig
from refield.estimate.paper.newcomer import newcomer_grid
from refield.estimate.paper.pose import MatchedPose, agreeing, landing, matched_pixels, matched_pose
from refield.estimate.paper.refine import Refined, interest, refine
from refield.estimate.paper.segment import OldMask
from refield.estimate.segment import masks_in
from refield.field.radiance import Field
from refield.scene.capture import Frame
from refield.scene.change import ObjectChange, OccupancyGrid
from refield.scene.pose import angle_between


@dataclass(frozen=True)
class Scene:
    """What all steps know."""

    frames: Sequence[Frame]
    """the old training photos"""
    field: Field
    models: Models
    config: PaperConfig
    survey: Sequence[View]
    """renderings of the old field"""


@dataclass(frozen=True)
class Settled:
    """What is held to have happened to one object."""

    gone: Thing | None
    came: Thing | None
    cloud: Array
    """(N, 3) its points at its old place"""
    matched: MatchedPose | None = None
    refined: Refined | None = None
    note: str = ""


@dataclass(frozen=True)
class Outcome:
    """One object's change, or why there is none."""

    settled: Settled
    change: ObjectChange | None
    why: str


def settle(scene: Scene, partners: Partners) -> list[Settled]:
    """Where the object went; one whose two sides share no pose is taken for one that left and one that arrived."""
    gone, came, c = partners.gone, partners.came, scene.config
    cloud = segment.object_cloud([] if gone is None else _on_renders(gone), c.segment.nearest)
    if gone is None or came is None:
        return [Settled(gone, came, cloud)]
    found = matched_pose(gone, came, scene.models.matcher, c.pose)
    if found is None or landing(cloud, came, found.new_from_old) < c.pose.lands:
        note = "what left and what arrived look alike, but their features agree on no pose"
        return [Settled(gone, None, cloud, note=note), Settled(None, came, cloud[:0], note=note)]
    return [Settled(gone, came, cloud, found, refined_pose(scene.field, found, came, c))]


def refined_pose(field: Field, found: MatchedPose, came: Thing, config: PaperConfig) -> Refined:
    """A pose from features, refined (§9.3) unless that leads away from the features."""
    features = matched_pixels(found.matches)
    masks = {s.pair.view.frame.name: s.mask for s in came.sightings}
    targets = interest(features, [masks[v.frame.name] for v, _ in features], config.refine)
    better = refine(field, targets, found.new_from_old, config.refine)
    before, after = (
        sum(agreeing(m, pose, config.pose.error) for m in found.matches)
        for pose in (found.new_from_old, better.new_from_old)
    )
    if after < config.refine.keeps * before:
        return replace(better, new_from_old=found.new_from_old, loss=better.before)
    return better


def outcome(scene: Scene, s: Settled) -> Outcome:
    """The object in 3-D and on the old photos, as far as the photos show it."""
    if s.gone is None:
        return _arrived(scene, s)
    views, c = len(s.gone.sightings), scene.config
    if views < 2 or len(s.cloud) == 0:
        # §12.2.1: with a single view the paper's boxes are wrong on many old photos, and the object with them
        return Outcome(s, None, f"1 not segmented: {views} new photo shows one side only of where it was; give more")
    asked = segment.old_masks(scene.frames, s.cloud, scene.models.segmenter, c.max_pixels, c.segment)
    shown = sum(m.mask is not None and bool(m.mask.any()) for m in asked)
    if shown < c.segment.photos:
        why = f"1 not segmented: the segmenter is sure of it on {shown} of {len(asked)} old photos"
        return Outcome(s, None, f"{why}; {c.segment.photos} are needed")
    grid = segment.carved_grid(s.cloud, asked, c.segment)
    if not bool((grid.values > 0.5).any()):
        return Outcome(s, None, "1 not segmented: the masks on the old photos have no place in common")
    return _segmented(scene, s, asked, grid)


def _segmented(scene: Scene, s: Settled, asked: Sequence[OldMask], grid: OccupancyGrid) -> Outcome:
    """An object that moved or left, and its masks on the old photos."""
    masks = tuple(m.full() for m in asked)
    unsure = sum(m is None for m in masks)
    confidence = _score(s) * (1 - unsure / len(masks))
    left_out = f"the segmenter was not sure of it on {unsure} of {len(masks)} old photos" if unsure else ""
    note = "; ".join(n for n in (s.note, left_out) if n)
    if s.matched is None or s.refined is None:
        why = f"1 removed: {len(_sightings(s.gone))} new photos no longer show it{_because(s)}"
        return Outcome(s, ObjectChange("removed", grid, masks=masks, confidence=confidence, note=note), why)
    pose = s.refined.new_from_old
    now = masks_in(scene.frames, grid.moved(pose))
    change = ObjectChange("moved", grid, pose, masks, now, confidence=confidence * s.matched.share, note=note)
    return Outcome(s, change, _why_moved(change, s.matched))


def _arrived(scene: Scene, s: Settled) -> Outcome:
    """An object that the old field does not have."""
    assert s.came is not None  # one of the two sides is there
    count = len(s.came.sightings)
    if count < 2:
        return Outcome(s, None, f"1 not placed: {count} new photo alone shows something that arrived; give more")
    grid = newcomer_grid(s.came, scene.survey, scene.config.hull)
    if grid is None:
        return Outcome(s, None, f"1 not placed: its masks on {count} new photos meet in no place that was empty")
    masks = masks_in(scene.frames, grid)
    change = ObjectChange("added", grid, masks_in=masks, confidence=_score(s), note=s.note)
    return Outcome(s, change, f"1 added: {count} new photos show it{_because(s)}")


def _because(s: Settled) -> str:
    return f" ({s.note})" if s.note else ", and it has no partner that looks like it"


def _score(s: Settled) -> float:
    """The segmenter's mean over all masks of the new views."""
    scores = [x.score for x in _sightings(s.gone) + _sightings(s.came)]
    return sum(scores) / len(scores)


def _why_moved(moved: ObjectChange, matched: MatchedPose) -> str:
    assert moved.new_from_old is not None and moved.shift is not None
    turn = float(angle_between(moved.new_from_old, torch.eye(4, dtype=torch.float64)))
    shift = float(moved.shift.norm())
    agree = f"{matched.inliers} matched features agree ({100 * matched.share:.0f} % of the best pair's)"
    return f"1 moved by {shift:.4g} and turned by {turn:.0f} degrees: {agree}"


def _sightings(thing: Thing | None) -> tuple[Sighting, ...]:
    return () if thing is None else thing.sightings


def _on_renders(thing: Thing) -> list[tuple[View, Mask]]:
    """A thing's masks as they lie over the rendered depth."""
    return [(s.pair.view, s.pair.on_render(s.mask)) for s in thing.sightings]
