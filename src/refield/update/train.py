"""Bring a field up to date (§4.1): freeze, mask, fit a helper, show it where it knows better."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from refield.field.pixels import PixelBank
from refield.field.radiance import Field, check_field
from refield.field.render import render_many
from refield.field.sampling import OccupancySampler
from refield.field.warp import crosses, outline
from refield.scene.capture import Capture, Frame, Rays, centres, check_capture
from refield.scene.change import SceneChange
from refield.scene.errors import expect
from refield.scene.pose import transform
from refield.update.bare import bare_skin
from refield.update.composite import UpdatedField
from refield.update.config import UpdateConfig
from refield.update.evidence import as_remembered, recalled_pixels
from refield.update.fit_helper import HelperTraining, Lit, UpdateProgress
from refield.update.fit_textured import textured_planes
from refield.update.frozen import Segments, composite_once
from refield.update.ground import Foothold, footholds, planes_around
from refield.update.helper import new_helper, step_near
from refield.update.light import Relighting, Sightings, fit_light
from refield.update.paper.config import reduced
from refield.update.paper.field import PaperField
from refield.update.paper.route import update_field_paper
from refield.update.recall import earlier_of
from refield.update.region import Region, finer, meets, move_out, without_planes
from refield.update.spared import spared
from refield.update.supervision import Lessons, changed_pixels, new_lessons, old_ring, places_of
from refield.update.textured import TexturedPlane
from refield.update.unseen import Sight, sight_of

DEFAULTS = UpdateConfig()
_PATCHES, _SHADING_CELLS = 8, 24  # an object's side in patches that are left out together; in cells
_PATCH = 4.0  # cells of the light's lattice that are left out together where one photo alone shows a place
_LIT_RAYS = 60_000  # of the new photos, for the light on all and on each object; a lattice of factors is no finer
_NEW_RAYS = 1 << 18  # of the new photos, through the region; about as many as training draws
_MADE = 20  # of the old photos that an earlier visit put out of date; each takes longer to put right than to learn from
_GROUND_RAYS = 12_000  # that planes are looked for along
_TOLD = 0.05  # dB; less is told as 0.0
_RING_ASKED = 1 << 20  # of the old photos' pixels, whether their rays meet the region
_RING_RAYS = 40_000  # of the old photos; more add time and nothing to learn


def update_field(
    capture: Capture,
    field: Field,
    change: SceneChange,
    config: UpdateConfig = DEFAULTS,
    on_stage: Callable[[str], None] | None = None,
    on_progress: Callable[[UpdateProgress], None] | None = None,
) -> UpdatedField | PaperField:
    """The field of the changed scene; ``field`` itself is not touched.

    ``capture`` holds the old photos, ``change`` what changed and the new photos; without new photos the old objects
    are cut out and the moved ones moved. ``on_stage`` hears the name of each stage as it begins.

    Raises:
        InputError: the paper's route cannot take the field, or has no new photos (`update_field_paper`).
        NonFiniteError: the helper's loss was not finite for 20 steps in a row before its first look; after one, the
            best state is kept and ``why_stopped`` says so.
    """
    check_capture(capture)
    check_field(field)
    expect("the change", change, SceneChange, "a SceneChange, as refield.estimate_change makes one")
    if config.route != "refield":
        asked = config.paper if config.route == "paper" else reduced(config.paper)
        return update_field_paper(capture, field, change, asked, on_stage, on_progress)
    say = on_stage or (lambda name: None)
    draw = torch.Generator().manual_seed(config.seed)
    say("move")
    eyes = centres(capture.train).float()
    base, earlier = earlier_of(field, change, config.dilation)
    cut = UpdatedField(base, change, eyes=eyes, earlier=earlier)
    if not change.objects or not change.frames:
        return cut
    known = _known_of(capture, field, cut, config.held_out, draw)
    cut = known.cut
    say("light")
    light = _light(known, draw) if config.relight else None
    shading = _shading(known.sparse.taught, cut, change, draw) if config.relight else ()
    lit = partial(
        UpdatedField,
        cut.pretrained,
        change,
        light=light,
        shading=shading,
        eyes=cut.eyes,
        bare=cut.bare,
        earlier=cut.earlier,
    )
    unknown = move_out(cut.to_learn, config.dilation).grids + cut.earlier.unknown.grids
    wide = Region(unknown + cut.bare.grids)
    if not wide.grids:
        updated = lit(region=wide)
        updated.why_stopped = "earlier visits know all of it"
        return _without_harm(updated, known)
    say("supervise")
    middle = wide.box.mean(0)
    step = step_near(field, middle)
    near = _in_reach(wide.sampler(step), capture.train + change.frames)
    # what earlier visits know has been taken from them already; of the rest no old photo shows anything
    old = _old_lessons(capture, cut, near, config, light, draw) if cut.to_learn.objects else known.sparse[:0]
    sparse = known.sparse[_some(meets(near, known.sparse.rays).nonzero()[:, 0], _NEW_RAYS, draw)]
    if len(sparse) + len(old) == 0:
        updated = lit(region=cut.region)
        updated.why_stopped = "no photo shows any of it, so that nothing could be learnt"
        return _without_harm(updated, known)
    ground = _ground(known, old, wide, eyes, max(_pixel(change, middle), step), draw)
    sight = sight_of(cut.pretrained, capture.train, _beside(wide))
    planes = _textured(known, ground, sight, config.ground, _pixel(change, middle))
    say("freeze")
    told, region = Region(wide.grids, planes), finer(without_planes(near, planes))
    frozen = lit(region=told).unshown(sight.hidden)
    if not region.grid.any():
        frozen.why_stopped = "there is nothing but the ground to show"
        return _without_harm(frozen, known)
    parts = (sparse.taught, old, sparse.judging)
    taught, remembered, judge = (Lit(some, _fixed(frozen, region, some.rays, ground)) for some in parts)
    say("train")
    helper = new_helper(region, change.frames, config.seed)
    run = HelperTraining(helper, frozen, taught, remembered, judge, config, draw, ground, sight)
    run.run(on_progress)
    say("show")
    helper.requires_grad_(False)
    updated = lit(helper=helper, region=told).unshown(sight.hidden)
    updated.why_stopped = run.why_stopped
    return _without_harm(updated, known)


def _without_harm(updated: UpdatedField, known: _Known) -> UpdatedField:
    """The update without the parts of it that show unchanged pixels worse; ``notes`` says which, and what it costs."""
    judging = known.sparse.judging
    kept = spared(updated, judging, judging.within(known.changed))
    notes = [f"left out of the update: {o.part} (unchanged pixels gain {o.gain:.1f} dB)" for o in kept.left_out]
    if kept.lost >= _TOLD:
        notes.append(f"unchanged pixels beside what changed are shown {kept.lost:.1f} dB worse than before")
    kept.field.notes = tuple(notes)
    return kept.field


@dataclass(frozen=True)
class _Known:
    """What there is before anything is learnt."""

    cut: UpdatedField
    """the old field, with the objects moved and cut out, and what earlier visits know"""
    sparse: Lessons
    """pixels of the new photos"""
    changed: tuple[np.ndarray, ...]
    """of each new photo, (H, W) bool: what arrived or left"""
    recalled: tuple[np.ndarray, ...]
    """of each new photo, (H, W) bool: what only an earlier visit knows"""


def _known_of(capture: Capture, field: Field, cut: UpdatedField, held_out: int, draw: torch.Generator) -> _Known:
    """What is known, once the new photos have been asked about what is only remembered."""
    change, eyes = cut.change, cut.eyes
    places = places_of(change)
    changed = tuple(changed_pixels(change, places, i, f) for i, f in enumerate(change.frames))
    sparse = new_lessons(change.frames, cut, changed, held_out, draw)
    recalled = tuple(recalled_pixels(cut, f) for f in change.frames)
    if cut.earlier and not as_remembered(cut, sparse, changed, recalled, draw):
        cut = UpdatedField(field, change, eyes=eyes)
        recalled = tuple(np.zeros_like(r) for r in recalled)
    bare = bare_skin(cut, capture.train, change)
    if bare.grids:
        empty = Region(cut.region.grids + bare.grids)
        cut = UpdatedField(cut.pretrained, change, region=empty, eyes=eyes, bare=bare, earlier=cut.earlier)
    return _Known(cut, sparse, changed, recalled)


def _fixed(frozen: UpdatedField, region: OccupancySampler, rays: Rays, ground: Sequence[Foothold]) -> Segments:
    """What is fixed along rays. Nothing beyond the ground that an object stood on: nobody has ever looked through it,
    and where the old field's inside shows as through a mist, a helper needs not become solid."""
    fixed = composite_once(frozen, region, rays)
    met = torch.full((len(rays),), torch.inf)  # where a textured plane hides what is beyond it, and has to stay
    for plane in frozen.region.planes:
        met = torch.where(plane.hit(rays), torch.minimum(met, plane.met(rays) - plane.depth), met)
    for foothold in ground:
        entered = foothold.entered(rays)
        fixed = fixed.before(torch.where(met < entered, torch.inf, entered))
    return fixed


def _textured(
    known: _Known, ground: Sequence[Foothold], sight: Sight, reach: float, pixel: float
) -> tuple[TexturedPlane, ...]:
    """The texture of the ground that objects stood on, and of what is beside these places and the new ones."""
    if not ground:
        return ()
    cut = known.cut
    places = [o.grid for o in cut.to_learn.objects] + [m.grid.moved(m.new_from_old) for m in cut.moves]
    around = Region(tuple(g.dilated(reach) for g in places) + cut.earlier.unknown.grids)
    arrived = tuple(g for o in cut.change.objects if (g := o.grid_now) is not None)
    return textured_planes(
        ground, around, cut, sight.dark, Region(arrived + cut.bare.grids), known.sparse.taught, pixel
    )


def _in_reach(region: OccupancySampler, frames: tuple[Frame, ...]) -> OccupancySampler:
    """The same region, its rays no longer than it takes to cross it from the furthest photo."""
    space = region.contraction
    furthest = max(float((f.centre.float() - space.centre).norm()) for f in frames)
    return replace(region, far=furthest / space.radius + 2)


def _light(known: _Known, draw: torch.Generator) -> Relighting | None:
    """The light on what is known, from the new photos' pixels that show it; each photo is a fold."""
    change, sparse = known.cut.change, known.sparse.taught
    box = Region(tuple(g for o in change.objects for g in (o.grid, o.grid_now) if g is not None)).box
    side = max(float((o.grid.tight_aabb().diff(dim=0)).max()) for o in change.objects)
    box = torch.stack([box[0] - 1.5 * side, box[1] + 1.5 * side])
    unknown = [c & ~r for c, r in zip(known.changed, known.recalled)]
    still = ~sparse.within(unknown)  # up to the objects' very edges, where their shadows are darkest
    may = (still & crosses(sparse.rays, [box])).nonzero()[:, 0]
    seen = sparse[_some(may, _LIT_RAYS, draw)]
    was = render_many(known.cut, seen.rays)
    x = seen.rays.origins + seen.rays.directions * was.depth[:, None]
    solid = (was.opacity > 0.9).nonzero()[:, 0]
    spacing = 1.5 * _pixel(change, box.mean(0))
    return fit_light(Sightings(x, seen.rgb, was.rgb, seen.photo)[solid], box, spacing, _PATCH * spacing)


def _pixel(change: SceneChange, x: Tensor) -> float:
    """Side of a new photo's pixel at a world point (3,), world units."""
    return min(float((f.centre.float() - x).norm()) / f.camera.fx for f in change.frames)


def _shading(
    sparse: Lessons, cut: UpdatedField, change: SceneChange, draw: torch.Generator
) -> tuple[Relighting | None, ...]:
    """How each moved object's own look changed with its place, kept at its old one.

    A side of it is often in one photo only, so patches of a photo are the folds, not photos.
    """
    out: list[Relighting | None] = []
    for i, move in enumerate(cut.moves):
        near = meets(Region((move.grid.moved(move.new_from_old),)).sampler(cut.sampler.step), sparse.rays)
        seen = sparse[_some(near.nonzero()[:, 0], _LIT_RAYS, draw)]
        now = render_many(cut, seen.rays)
        x = seen.rays.origins + seen.rays.directions * now.depth[:, None]
        asked = transform(move.old_from_new, x)
        solid = ((now.opacity > 0.9) & (cut.arrived(x) == i)).nonzero()[:, 0]
        box = outline(move.grid)
        side = float((box[1] - box[0]).mean())
        sightings = Sightings(asked, seen.rgb, now.rgb, seen.photo).in_patches(side / _PATCHES)
        spacing = max(side / _SHADING_CELLS, 2 * _pixel(change, x.mean(0)))
        box = torch.stack([box[0] - 3 * spacing, box[1] + 3 * spacing])  # a fit fades out at the border of its box
        out.append(fit_light(sightings[solid], box, spacing) if len(solid) else None)
    return tuple(out)


def _old_lessons(
    capture: Capture,
    cut: UpdatedField,
    region: OccupancySampler,
    config: UpdateConfig,
    light: Relighting | None,
    draw: torch.Generator,
) -> Lessons:
    """Ring pixels of the old photos whose rays meet the region, in the new light."""
    asked = _asked(capture.train)
    bank, places = PixelBank([capture.train[i] for i in asked]), places_of(cut.change)
    chosen = []
    for k, i in enumerate(asked):
        ring = old_ring(places, i, capture.train[i], config.shadow, config.far)
        if ring is not None:
            chosen.append(ring.reshape(-1).nonzero()[:, 0] + bank.starts[k])
    pixels = _some(torch.cat(chosen) if chosen else torch.zeros(0, dtype=torch.long), _RING_ASKED, draw)
    pixels = pixels[meets(region, bank.rays(pixels)).nonzero()[:, 0]]
    pixels = _some(pixels, _RING_RAYS, draw)
    rays, rgb = bank.rays(pixels), bank.colours(pixels)
    if light is not None:
        was = render_many(cut.pretrained, rays)
        rgb = light.applied(rays.origins + rays.directions * was.depth[:, None], rgb)
    return Lessons(
        rays, rgb, torch.full_like(pixels, -1), bank.place_of(pixels), torch.zeros(len(pixels), dtype=torch.bool)
    )


def _some(rows: Tensor, most: int, draw: torch.Generator) -> Tensor:
    """``most`` of the rows (K,) at random, in order; all, if there are no more."""
    return rows if len(rows) <= most else rows[torch.randperm(len(rows), generator=draw)[:most].sort().values]


def _beside(region: Region) -> list[Tensor]:
    """World boxes (2, 3) three times as large as the region's."""
    return [torch.stack([2 * b[0] - b[1], 2 * b[1] - b[0]]) for b in region.boxes]


def _ground(
    known: _Known, old: Lessons, wide: Region, eyes: Tensor, resolved: float, draw: torch.Generator
) -> list[Foothold]:
    """What stood on planes where something is to be learnt: the objects that left, and what is left to learn of places
    that earlier visits know. The planes are looked for along the rays of the old photos that teach, else along those of
    the new ones that pass nearby."""
    cut, shown, rays = known.cut, known.cut.pretrained, old.rays
    if len(rays) == 0:
        near = crosses(known.sparse.rays, _beside(wide))
        shown, rays = cut, known.sparse.rays[near.nonzero()[:, 0]]
    rays = rays[torch.randperm(len(rays), generator=draw)[:_GROUND_RAYS]]
    points = rays.origins + rays.directions * render_many(shown, rays).depth[:, None]
    planes = planes_around(points, wide.box, eyes, resolved, draw)
    return footholds(
        [o.grid for o in cut.to_learn.objects if o.kind != "added"] + list(cut.earlier.unknown.grids), planes
    )


def _asked(frames: Sequence[Frame]) -> list[int]:
    """Indices of the old photos that teach: all of them, but only some of those that have yet to be made."""
    made = [i for i, f in enumerate(frames) if f.made is None]
    unmade = [i for i, f in enumerate(frames) if f.made is not None]
    return sorted(made + unmade[:: -(-len(unmade) // _MADE) or 1])
