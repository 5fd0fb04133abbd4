"""A world drawn at random: every choice comes from the seed.

A place, its light and a camera path are drawn first; then objects and their changes, anew until nothing stands in
anything else and the photos show every change. Seeds from 2000 on draw every kind of capture: photos taken from within,
portrait and landscape mixed, 20 to 300 of them. Earlier ones look at a place from outside, all in one format, unless
that is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from torch import Tensor

from refield.scene.camera import Camera
from refield.scene.errors import InputError
from refield.synthetic.disturb import Disturbance
from refield.synthetic.random_light import Light, lamps, sky, studio
from refield.synthetic.random_paths import PATHS, CameraPath, draw_camera, draw_path, in_both, turned
from refield.synthetic.random_places import Place, draw_place, in_room
from refield.synthetic.random_rounds import ROUNDS, RoundPath, draw_round
from refield.synthetic.random_scenes import Thing, draw_change, draw_kinds, draw_things
from refield.synthetic.random_views import Views, seen_by
from refield.synthetic.state import State, World

NEW = 4
"""new photos, and as many for evaluation"""
_LEAST, _MOST = 30, 120  # old photos
_EVERY_KIND = 2000  # the first seed that draws every kind of capture
_FEW, _FEW_AROUND, _MANY = 20, 60, 300  # old photos of these, and of those of them that look all around
_WITHIN, _MIXED = 0.35, 0.3  # of these: taken from within, portrait and landscape mixed
_TURNED = 0.4  # of the photos, where they are mixed
_TESTED, _TESTED_AROUND = 16, 48  # old views that a draw is judged by
_SCENES, _PLACES = 25, 40  # draws of objects in one place; draws of places


@dataclass(frozen=True)
class RandomWorld:
    """A world with the cameras that see it."""

    world: World
    camera: Camera
    """1200 pixels at its longer side, to be scaled"""
    mixed: bool
    """whether some of the photos are turned, portrait among landscape or the other way round"""
    old: tuple[Tensor, ...]
    """world_from_cam (4, 4) float64 each, as the next two"""
    new: tuple[Tensor, ...]
    evaluation: tuple[Tensor, ...]
    disturbance: Disturbance | None
    """of old and new photos"""
    brightness: float
    """mean of the photos that the light is to be scaled to, sRGB in [0, 1]"""
    facts: dict[str, Any]
    """all that was chosen, for ``world.json``"""

    def cameras(self, folder: str, count: int) -> list[Camera]:
        """Of the photos of a folder."""
        rng = np.random.default_rng([self.facts["seed"], *folder.encode()])
        turns = rng.random(count) < _TURNED if self.mixed else np.zeros(count, bool)
        return [turned(self.camera) if turn else self.camera for turn in turns]


def random_world(seed: int, photos: int | None = None, path: str | None = None, mixed: bool = False) -> RandomWorld:
    """The world of a seed; ``photos`` old ones, or as many as the seed says.

    Args:
        path: the family of the cameras' path, `PATHS` or `ROUNDS`; None: as the seed says.
        mixed: portrait and landscape, whatever the seed says.

    Raises:
        InputError: there is no such path, or nothing fitted in a great many draws.
    """
    if path is not None and path not in (*PATHS, *ROUNDS):
        raise InputError(f"path {path!r}", "there is no such path", f"choose one of {', '.join((*PATHS, *ROUNDS))}")
    rng = np.random.default_rng([seed, *b"random"])
    count, brightness = int(rng.integers(_LEAST, _MOST + 1)), float(rng.uniform(0.36, 0.48))
    disturbance, kinds = _disturbance(rng, seed), draw_kinds(rng)
    if seed >= _EVERY_KIND:
        own_path, own_mixed, count = _every_kind(seed)
        path, mixed = path or own_path, mixed or own_mixed
    for _ in range(_PLACES):
        frame = _frame(rng, path, mixed)
        found = _scene(rng, frame, kinds)
        if found is not None:
            break
    else:
        raise InputError(f"--seed {seed}", f"nothing fitted in {_PLACES} places", "take another seed")
    place, light, camera, way, views = frame
    things, changes, before, after, seen = found
    world = World("random", before, after, place.target)
    old = way.poses(np.random.default_rng([seed, *b"path"]), photos or count)
    facts = {
        "seed": seed,
        "place": place.family,
        "setting": "room" if light.lamps else "studio" if light.family == "studio" else "outdoors",
        "ground": place.ground,
        "light": light.family,
        "path": way.family,
        "field_of_view_deg": round(float(2 * np.rad2deg(np.arctan(600 / camera.fx))), 1),
        "aspect": round(camera.width / camera.height, 3),
        "photos": len(old),
        "brightness": round(brightness, 3),
        "disturbance": None if disturbance is None else asdict(disturbance),
        "changes": sorted({kind for kind in changes.values() if kind != "none"}),
        "objects": [_told(thing, changes[thing.item.name], seen) for thing in things],
    }
    if mixed:
        facts["portrait and landscape"] = True
    new = (tuple(views.new), tuple(views.evaluation))
    return RandomWorld(world, camera, mixed, tuple(old), *new, disturbance, brightness, facts)


def _every_kind(seed: int) -> tuple[str | None, bool, int]:
    """Of a seed that draws every kind of capture: a path from within or None, whether mixed, how many old photos."""
    rng = np.random.default_rng([seed, *b"kinds"])
    path = str(rng.choice(ROUNDS)) if rng.random() < _WITHIN else None
    few = _FEW if path is None else _FEW_AROUND
    return path, bool(rng.random() < _MIXED), round(float(few * (_MANY / few) ** rng.random()))


_Frame = tuple[Place, Light, Camera, CameraPath | RoundPath, Views]
_Scene = tuple[Sequence[Thing], dict[str, str], State, State, dict[str, dict[str, float]]]


def _frame(rng: np.random.Generator, family: str | None, mixed: bool) -> _Frame:
    """Where it is, in which light, and from where it is seen."""
    if family in ROUNDS:
        return _frame_around(rng, family, mixed)
    setting = str(rng.choice(["room", "studio", "outdoors"], p=[0.4, 0.15, 0.45]))
    place, camera = draw_place(rng, outdoors=setting == "outdoors"), _camera(rng, mixed)
    while family is not None and family not in place.views:
        place = draw_place(rng, outdoors=setting == "outdoors")
    path = draw_path(rng, place if family is None else replace(place, views=(family,)), camera)
    views = _views(rng, place, path, in_both(camera) if mixed else camera, _TESTED)
    eyes = np.stack([pose[:3, 3].numpy() for pose in views.all])
    if setting == "room":
        wide = float(np.abs(eyes[:, :2]).max()) + float(rng.uniform(0.3, 1.0))
        wide = max(wide, 2.0 * place.reach)
        high = max(float(eyes[:, 2].max()) + 0.4, 2.2, place.target[2] + 1.5 * place.reach)
        return in_room(rng, place, wide, high), lamps(rng, place, wide, high), camera, path, views
    return place, sky(rng) if setting == "outdoors" else studio(rng), camera, path, views


def _frame_around(rng: np.random.Generator, family: str, mixed: bool) -> _Frame:
    """The same with cameras in the middle."""
    within = family == "inside-out"
    setting = "room" if within else str(rng.choice(["room", "studio", "outdoors"], p=[0.5, 0.1, 0.4]))
    place, path, edge = draw_round(rng, family, outdoors=setting == "outdoors")
    camera = _camera(rng, mixed)
    views = _views(rng, place, path, in_both(camera) if mixed else camera, _TESTED_AROUND)
    if setting == "room":
        high = max(max(path.heights) + 0.4, 2.2, 2.5 * place.reach)
        return in_room(rng, place, edge, high), lamps(rng, place, edge, high), camera, path, views
    return place, sky(rng) if setting == "outdoors" else studio(rng), camera, path, views


def _camera(rng: np.random.Generator, mixed: bool) -> Camera:
    camera = draw_camera(rng)
    while mixed and camera.width == camera.height:
        camera = draw_camera(rng)
    return camera


def _views(rng: np.random.Generator, place: Place, path: CameraPath | RoundPath, camera: Camera, tested: int) -> Views:
    old, new, evaluation = path.poses(rng, tested), path.new_poses(rng, NEW), path.new_poses(rng, NEW)
    return Views(camera, old, new, evaluation, path.distance, place.target, isinstance(path, RoundPath))


def _scene(rng: np.random.Generator, frame: _Frame, kinds: Sequence[str]) -> _Scene | None:
    """Objects and changes that fit and are seen; None after many draws."""
    place, light, _, _, views = frame
    empty = State(place.items, light.surroundings)
    fixed = views.depths(empty)
    if not views.clear(fixed):
        return None
    for _ in range(_SCENES):
        things = draw_things(rng, place, kinds)
        if things is None:
            continue
        drawn = draw_change(rng, place, things, kinds)
        if drawn is None:
            continue
        before, after = (
            light.on(replace(empty, items=(*place.items, *items))) for items in (drawn.before, drawn.after)
        )
        seen = seen_by(views, fixed, drawn)
        if seen is not None:
            return drawn.things, drawn.kinds, before, after, seen
    return None


def _told(thing: Thing, kind: str, seen: dict[str, dict[str, float]]) -> dict[str, Any]:
    size = 2 * float(np.sqrt(np.mean(np.square(thing.item.solid.half))))
    return {
        "name": thing.item.name,
        "family": thing.family,
        "texture": thing.pattern,
        "size": round(size, 3),
        "change": kind,
        **{key: round(value, 4) for key, value in seen[thing.item.name].items()},
    }


def _disturbance(rng: np.random.Generator, seed: int) -> Disturbance | None:
    """As a phone's photos are; none at all for a fifth of the seeds."""
    none = bool(rng.random() < 0.2)
    strong = rng.uniform(0, 1, 6)
    quality = [None, None, 95, 90, 80][int(rng.integers(5))]
    if none:
        return None
    return Disturbance(
        exposure=round(float(0.25 * strong[0]), 3),
        white_balance=round(float(0.05 * strong[1]), 3),
        noise=round(float(0.025 * strong[2]), 4),
        blur=round(float(0.8 * strong[3]), 3) if strong[3] > 0.4 else 0.0,
        pose_px=round(float(0.5 * strong[4]), 3),
        vignetting=round(float(0.3 * strong[5]), 3),
        jpeg=quality,
        seed=seed,
    )
