"""estimate_change(): the steps of §4.2 in order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch

from refield.estimate import detect, hull, light, look
from refield.estimate.conclude import Told, concluded, disagreeing
from refield.estimate.detect import Changed, DetectConfig, Errors, Mask
from refield.estimate.faces import Part, changed_parts
from refield.estimate.ground import AssociateConfig, Ground
from refield.estimate.hull import Hull, HullConfig
from refield.estimate.lattice import grown
from refield.estimate.light import SAME_PLACE
from refield.estimate.likelihood import Settled, unexplained_at
from refield.estimate.look import Array, View
from refield.estimate.memory import Memory
from refield.estimate.models import ModelConfig, Models
from refield.estimate.objects import Old
from refield.estimate.outline import ObjectConfig, Seeds, outline, remembered
from refield.estimate.paper.config import PaperConfig
from refield.estimate.paper.detect import detect as detect_paper
from refield.estimate.paper.route import estimate_change_paper
from refield.estimate.place import PlaceConfig, place
from refield.estimate.pose_change import RefineConfig
from refield.estimate.register import RegisterConfig
from refield.estimate.settle import Search, is_piece
from refield.estimate.tally import OnCount, Tally
from refield.field.radiance import Field, check_field
from refield.field.source import Known
from refield.scene.capture import Capture, Frame, check_capture, check_frames
from refield.scene.change import PlacedPhoto, SceneChange
from refield.scene.errors import InputError
from refield.scene.planes import EXACT, Plane, holds_up, support_planes, support_tops

OnStage = Callable[[str], None]
_MUCH_NEW = 0.02  # of a photo's pixels, from which on it is said that no old photo saw what they show
_OTHER_LIGHT = 2.0  # times brighter or darker, from which on a photo's light is spoken of
_MISSED = 0.5  # of its own photos' variance; a field that does not show more of it tells no change


@dataclass(frozen=True)
class EstimateConfig:
    """What changed? Every step's settings."""

    max_pixels: int = 24_000
    """photos are scaled down to this for everything but the refinement of poses"""
    survey: int = 10
    """old photos that the field's own errors are learnt from; and as many at most of those that are held out of the
    capture tell how much of such a photo would be taken for changed"""
    most_changed: float = 0.5
    """if more of a photo's pixels changed, it shows another scene, unless the field is more like it, and like another
    such photo, from its own place than from others"""
    place: PlaceConfig = field(default_factory=PlaceConfig)
    """the new photos' poses"""
    masks: Literal["refield", "paper"] = "refield"
    """whose step says which pixels changed: refield's (``detect``), or the paper's (``paper.detect``) with all that
    follows it refield's"""
    detect: DetectConfig = field(default_factory=DetectConfig)
    """change masks"""
    hull: HullConfig = field(default_factory=HullConfig)
    """the change in 3-D"""
    objects: ObjectConfig = field(default_factory=ObjectConfig)
    """the old objects' shapes"""
    register: RegisterConfig = field(default_factory=RegisterConfig)
    """search for poses"""
    refine: RefineConfig = field(default_factory=RefineConfig)
    """refinement of poses through the field"""
    associate: AssociateConfig = field(default_factory=AssociateConfig)
    """what is believed"""
    route: Literal["refield", "paper"] = "refield"
    """refield's own steps, or those of the paper as it gives them (``estimate.paper``)"""
    paper: PaperConfig = field(default_factory=PaperConfig)
    """the paper's route"""
    models: ModelConfig = field(default_factory=ModelConfig)
    """what cuts things out and what finds corresponding points"""


@dataclass(frozen=True)
class _Scene:
    """What all steps after the first know."""

    capture: Capture
    field: Field
    config: EstimateConfig
    survey: tuple[View, ...]
    errors: Errors
    changed: tuple[Changed, ...]
    photos: tuple[PlacedPhoto, ...]
    """all of the new ones; ``changed`` goes with those that are used"""
    planes: list[Plane]
    """what holds things up"""
    models: Models
    known: tuple[Known, ...]
    """objects that earlier visits found, where they stood before this one"""


def estimate_change(
    capture: Capture,
    field: Field,
    frames: Sequence[Frame],
    config: EstimateConfig = EstimateConfig(),
    on_stage: OnStage | None = None,
    models: Models | None = None,
    known: Sequence[Known] = (),
    on_count: OnCount | None = None,
) -> SceneChange:
    """What moved, left or arrived between the capture that ``field`` was fitted to and a few new photos (§4.2).

    Args:
        frames: the new photos, with poses in the capture's world.
        on_stage: called with each step's name as it begins.
        models: a segmenter that tells things from what is behind them in the old field's pictures, and a matcher;
            those that the config names if not given.
        known: what earlier visits found, where it stood before this one: an object that moves again need not be
            segmented again (§11.3.2).
        on_count: called with how many explanations were tried, and how many there are as far as is known; not on the
            paper's route, which tries one.

    Raises:
        InputError: there is no new photo; most of the pixels changed: the photos show another scene; the field does not
            show its own photos; or a model cannot be opened.
    """
    check_capture(capture)
    check_field(field)
    check_frames(frames)
    models = config.models.open() if models is None else models
    if config.route == "paper":
        return estimate_change_paper(capture, field, frames, models, config.paper, on_stage)
    say = on_stage or (lambda name: None)
    say("detect")
    scene = replace(_detected(capture, field, frames, config, models), known=tuple(known))
    photos = scene.photos
    beside = _light(photos) + _never_seen(scene.changed)
    if not any(c.certain.any() for c in scene.changed):
        why = "no pixel differs by more than the field's own errors on the old photos"
        return SceneChange((), photos, why + beside)
    say("hull")
    hulls = _carved(scene)
    if not hulls:
        some = hull.find_regions(scene.changed, config.hull, 0.0)
        answer = disagreeing(scene.changed, photos, scene.errors, config.associate.smallest if some else 0.0)
        return replace(answer, why=answer.why + beside)
    parts = changed_parts(scene.changed, hulls, config.hull, models.segmenter)
    olds = _were_there(scene, parts.things or parts.others)
    say("pose")
    up = scene.planes[0].normal if scene.planes else _up(capture)
    photographed = [f for f in capture.frames if f.made is None]
    ground = Ground(
        field, hulls, up, scene.planes, scene.survey, scene.errors.memory, photographed,
        config.detect, config.hull, config.objects, config.associate, config.register, config.refine, models.matcher,
        Tally(on_count),
    )  # fmt: skip
    search = Search(ground, scene.changed)
    settled = search.settle(olds)
    told = [*olds, *settled.gone]
    more = _overlooked(scene, ground, settled, parts.others, told) if parts.things else []
    if more:
        settled = search.settle([o for o in more if not is_piece(o, [*told, *more])], settled)
    settled = search.likely(search.turned(settled))
    say("segment")
    answer = concluded(Told(ground, capture.train, scene.changed, photos, scene.errors), settled)
    return replace(answer, why=answer.why + _never_seen(scene.changed))


def _detected(
    capture: Capture, field: Field, frames: Sequence[Frame], config: EstimateConfig, models: Models
) -> _Scene:
    chosen = look.spread_out(capture.frames, config.survey)
    names = {f.name for f in chosen}
    beside = [f for f in look.spread_out(capture.held_out, config.survey) if f.name not in names]
    survey, left_out = ([look.view_of(field, f, config.max_pixels) for f in some] for some in (chosen, beside))
    _check_knows(survey)
    views = [_placed(field, f, config) for f in frames]
    errors = detect.errors(survey, Memory.of(field, capture.train), config.detect, left_out)
    changed = detect.changes(views, errors, config.detect)
    shares = [float(c.mask.mean()) for c in changed]
    much = [share > config.most_changed for share in shares]
    same = [m and detect.is_of_scene(c, survey, config.detect) for c, m in zip(changed, much)]
    others = [m and not (one and sum(same) > 1) for m, one in zip(much, same)]  # one alone may be by chance
    photos = tuple(_verdict(c.view, share, other) for c, share, other in zip(changed, shares, others))
    refused = sum(p.status == "rejected" for p in photos)
    if 2 * refused > len(photos):  # what was taken with them shows hardly another place
        what = f"{100 * float(np.mean(shares)):.0f} % of the pixels changed; is this the same scene?"
        give = "give photos of the scene that was trained, in its light, with poses in its world"
        raise InputError("new photos", what, give)
    if refused:
        used = [v for v, p in zip(views, photos) if p.status == "used"]
        changed = detect.changes(used, errors, config.detect)
    survey = [s.view for s in errors.shown]
    if config.masks == "paper":
        changed = _as_the_paper_sees(changed, survey, config, models)
    planes = _planes(survey, changed)
    changed = light.set_light_aside(changed, planes, config.detect)
    return _Scene(capture, field, config, tuple(survey), errors, tuple(changed), photos, planes, models, ())


def _check_knows(survey: Sequence[View]) -> None:
    """Refuse a field whose fit ended before it showed its own photos."""
    of_each = [((v.photo - v.rgb) ** 2).mean() / max(v.photo.var(axis=(0, 1)).mean(), 1e-6) for v in survey]
    missed = float(np.median(of_each))
    if missed > _MISSED:
        what = f"it shows its own photos hardly better than one colour would ({100 * (1 - missed):.0f} %)"
        raise InputError("the field", what, "go on with its fit: refield train WORK --more")


def _as_the_paper_sees(
    changed: Sequence[Changed], survey: Sequence[View], config: EstimateConfig, models: Models
) -> list[Changed]:
    """The same views with what the paper's step masks in them, whether it came or left."""
    found = detect_paper([c.view for c in changed], survey, models.segmenter, config.paper.detect)
    masks = [np.any([np.zeros(c.view.shape, bool), *m.move_in, *m.move_out], axis=0) for c, m in zip(changed, found)]
    return [replace(c, mask=mask, new=c.new & ~mask) for c, mask in zip(changed, masks)]


def _placed(field: Field, frame: Frame, config: EstimateConfig) -> View:
    """A new photo beside the old field's picture, from where the photo was really taken."""
    view = look.view_of(field, frame, config.max_pixels)
    placed = place(detect.carried(view, config.detect), config.place)
    if placed.shift == 0:
        return view
    return look.view_of(field, replace(frame, world_from_cam=placed.world_from_cam), config.max_pixels)


def _verdict(view: View, share: float, other: bool) -> PlacedPhoto:
    """What is made of a photo of whose pixels a ``share`` changed; ``other``: whether it shows another scene."""
    frame = view.frame
    if other:
        return PlacedPhoto(frame.name, "rejected", f"{100 * share:.0f} % of its pixels changed; it shows another scene")
    gain = float(view.colour_fit[0].mean())
    why = ""
    if not 1 / _OTHER_LIGHT < gain < _OTHER_LIGHT:
        why = f"{max(gain, 1 / gain):.1f} times {'darker' if gain > 1 else 'brighter'} than the field"
    return PlacedPhoto(frame.name, "used", why, frame)


def _light(photos: Sequence[PlacedPhoto]) -> str:
    """What is to be said of light that changed in whole photos."""
    other = [f"{p.name} is {p.why}" for p in photos if p.status == "used" and p.why]
    return f"; the light changed: {', '.join(other)}" if other else ""


def _never_seen(changed: Sequence[Changed]) -> str:
    """What is to be said of what no old photo saw, or too few for one new one."""
    shares = [(c.view.frame.name, float(c.new.mean())) for c in changed]
    much = [f"{100 * share:.0f} % of {name}" for name, share in shares if share >= _MUCH_NEW]
    said = f"; no old photo saw what is in {', '.join(much)}, so nothing is said of it" if much else ""
    guessed = [(c.view.frame.name, float((c.mask & c.guessed).mean())) for c in changed if c.guessed is not None]
    for name, share in guessed:
        if share >= _MUCH_NEW:
            said += f"; {100 * share:.0f} % of {name} differ where fewer than {detect.CERTAIN} old photos looked"
    return said


def _planes(survey: Sequence[View], changed: Sequence[Changed]) -> list[Plane]:
    """What holds up what changed, and stayed, if the field shows it exactly: through a surface that is uneven there are
    planes that hold parts of what stands on it, too."""
    near = np.concatenate([c.view.surface[c.mask & np.isfinite(c.view.depth)] for c in changed])
    points = np.concatenate([v.surface.reshape(-1, 3) for v in survey])
    eyes = np.repeat([v.centre for v in survey], [v.depth.size for v in survey], 0)
    if len(near) < 20:
        return []
    low, high = np.quantile(near, 0.05, axis=0), np.quantile(near, 0.95, axis=0)
    pad = 0.3 * float((high - low).max())
    around = np.flatnonzero(((points > low - pad) & (points < high + pad)).all(-1))
    some = around[np.random.default_rng(0).permutation(len(around))[:6000]]
    depths = [(c.view, c.view.depth[c.mask & np.isfinite(c.view.depth)]) for c in changed]
    sizes = [float(np.median(d)) * v.pixel_angle for v, d in depths if len(d)]
    points, eyes, exact = points[some], eyes[some], EXACT * float(np.median(sizes))
    endless = support_planes(points, np.stack([v.centre for v in survey]), exact)
    endless = [p for p in endless if holds_up(p, near, exact)]
    tops = [] if endless else support_tops(points, eyes, _still(points, changed), exact)
    return endless or [p for p in tops if holds_up(p, near, exact)]


def _still(points: Array, changed: Sequence[Changed]) -> Mask:
    """Which world points (N, 3) on old surfaces a new photo shows as they were, and none otherwise."""
    shown, touched = np.zeros(len(points), bool), np.zeros(len(points), bool)
    for c in changed:
        uv, seen = c.view.shows(points, SAME_PLACE)
        shown |= seen
        touched |= seen & c.view.lookup(c.mask, uv, seen)
    return shown & ~touched


def _carved(scene: _Scene) -> list[Hull]:
    """The change hull, place by place."""
    config, seen = scene.config.hull, [(c.witness(), c.mask) for c in scene.changed]
    old = [*scene.survey, *(c.view for c in scene.changed)]
    places = hull.find_regions(scene.changed, config, scene.config.associate.smallest)
    return [hull.carve(place, seen, old, scene.planes, config) for place in places]


def _were_there(scene: _Scene, parts: Sequence[Part], known: Sequence[Old] = ()) -> list[Old]:
    """Whole objects of the old field that parts of the change hull belong to, but for those already known."""
    found: list[Old] = []
    config = scene.config
    for part in parts[: config.associate.most]:
        at, carved = part.body.places, part.carved
        if any(old.lattice.holds(grown(old.voxels, old.margin), at).mean() > 0.5 for old in (*known, *found)):
            continue
        again = _known_at(scene, part)
        if again is not None:
            old = remembered(scene.field, scene.capture.train, again, scene.planes, config.objects)
            if old is not None:
                found.append(old)
                continue
        seeds = Seeds(carved.lattice, part.voxels, carved.hull, carved.unchanged, part.where)
        old = outline(scene.field, scene.capture.train, seeds, scene.planes, scene.models.segmenter, config.objects)
        if old is not None:
            found.append(old)
    return found


def _overlooked(scene: _Scene, ground: Ground, settled: Settled, others: Sequence[Part], told: list[Old]) -> list[Old]:
    """Objects that look like what a newcomer hides, since they go on outside of the changed pixels, and yet changed:
    more is left unexplained where they were than it costs that they did, newcomers left out; or an earlier visit knows
    them."""
    more, left = list[Old](), unexplained_at(ground, settled)
    for part in others:
        if left(part.body, 0) or _known_at(scene, part) is not None:
            found = _were_there(scene, [replace(part, where=part.voxels)], [*told, *more])
            more += [old for old in found if old.remembered or left(old, 0)]
    return more


def _known_at(scene: _Scene, part: Part) -> Known | None:
    """The object that earlier visits found there, where it stood before this one."""
    at = torch.from_numpy(part.body.places)
    return next((k for k in scene.known if k.grid.contains(at).float().mean() > 0.5), None)


def _up(capture: Capture) -> Array:
    """The direction most cameras hold upwards."""
    down = np.stack([f.world_from_cam[:3, 1].numpy() for f in capture.frames]).mean(0)
    return (-down / max(float(np.linalg.norm(down)), 1e-9)).astype(np.float32)
