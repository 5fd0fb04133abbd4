"""Bring a field up to date (§4.1): cut, relight, supervise, ground, freeze, fit, show; each stage in its own file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch

from refield.field.radiance import Field, check_field
from refield.field.sampling import OccupancySampler
from refield.scene.capture import Capture, Frame, centres, check_capture
from refield.scene.change import SceneChange
from refield.scene.errors import expect
from refield.update.composite import UpdatedField
from refield.update.config import UpdateConfig
from refield.update.cut import Known, cut_out, known_of
from refield.update.fit_helper import HelperTraining, Lit, UpdateProgress
from refield.update.fit_textured import textured_of
from refield.update.frozen import fixed_along
from refield.update.ground import ground_of
from refield.update.helper import new_helper, step_near
from refield.update.paper.config import reduced
from refield.update.paper.field import PaperField
from refield.update.paper.route import update_field_paper
from refield.update.region import Region, finer, meets, move_out, without_planes
from refield.update.relight import light_of, shading_of
from refield.update.spared import spared
from refield.update.supervision import at_most_of, old_lessons, places_of
from refield.update.unseen import nothing_seen, sight_of

DEFAULTS = UpdateConfig()
_NEW_RAYS = 1 << 18  # of the new photos, through the region; about as many as training draws
_TOLD = 0.05  # dB; less is told as 0.0


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
    cut = cut_out(capture, field, change, config.cut)
    if not change.objects or not change.frames:
        return cut
    known = known_of(capture, field, cut, config.cut, config.supervise, draw)
    cut, done = known.cut, partial(_done, known=known, config=config)
    say("light")
    light = light_of(known, draw) if config.relight.still else None
    shading = shading_of(known, draw) if config.relight.moved else ()
    lit = replace(cut.learnt, light=light, shading=shading)
    unknown = move_out(cut.to_learn, config.cut.dilation).grids + cut.earlier.unknown.grids
    wide = Region(unknown + cut.bare.grids)
    if not wide.grids:
        return done(cut.but(learnt=replace(lit, region=wide)), "earlier visits know all of it")
    say("supervise")
    middle = wide.box.mean(0)
    step, pixel = step_near(field, middle), known.pixel(middle)
    near = _in_reach(wide.sampler(step), capture.train + change.frames)
    old = known.sparse[:0]
    # of what earlier visits know and have been taken from already, no old photo shows anything
    if cut.to_learn.objects:
        old = old_lessons(capture.train, places_of(change), cut.pretrained, near, config.supervise, light, draw)
    sparse = at_most_of(known.sparse, meets(near, known.sparse.rays), _NEW_RAYS, draw)
    taught = sparse.taught.followed_by(old)
    if len(taught) == 0:
        return done(cut.but(learnt=lit), "no photo shows any of it, so that nothing could be learnt")
    seen_from = centres(capture.train).float()
    ground = ground_of(known, old, wide, seen_from, max(pixel, step), draw) if config.ground.footholds else []
    sight = (
        sight_of(cut.pretrained, capture.train, wide.around) if config.freeze.unseen else nothing_seen(cut.pretrained)
    )
    textured = ground if config.ground.textured else []
    planes = textured_of(known, textured, sight.dark, config.ground, pixel)
    say("freeze")
    told, region = Region(wide.grids, planes), finer(without_planes(near, planes))
    frozen = cut.but(learnt=replace(lit, region=told)).unshown(sight.hidden)
    if not region.grid.any():
        return done(frozen, "there is nothing but the ground to show")
    teaching, judging = (Lit(some, fixed_along(frozen, region, some.rays, ground)) for some in (taught, sparse.judging))
    say("train")
    helper = new_helper(region, change.frames, config.seed, directions=config.fit.directions)
    run = HelperTraining(helper, frozen, teaching, len(sparse.taught), judging, config.fit, draw, ground, sight)
    run.run(on_progress)
    say("show")
    helper.requires_grad_(False)
    updated = cut.but(learnt=replace(lit, helper=helper, region=told)).unshown(sight.hidden)
    return done(updated, run.why_stopped)


def _done(updated: UpdatedField, why_stopped: str, *, known: Known, config: UpdateConfig) -> UpdatedField:
    """The update without the parts of it that show unchanged pixels worse; ``notes`` says which, and what it costs."""
    updated.why_stopped = why_stopped
    if not config.show.spared:
        return updated
    judging = known.sparse.judging
    kept = spared(updated, judging, judging.within(known.changed))
    notes = [f"left out of the update: {o.part} (unchanged pixels gain {o.gain:.1f} dB)" for o in kept.left_out]
    if kept.lost >= _TOLD:
        notes.append(f"unchanged pixels beside what changed are shown {kept.lost:.1f} dB worse than before")
    kept.field.notes = tuple(notes)
    return kept.field


def _in_reach(region: OccupancySampler, frames: tuple[Frame, ...]) -> OccupancySampler:
    """The same region, its rays no longer than it takes to cross it from the furthest photo."""
    space = region.contraction
    furthest = max(float((f.centre.float() - space.centre).norm()) for f in frames)
    return replace(region, far=furthest / space.radius + 2)
