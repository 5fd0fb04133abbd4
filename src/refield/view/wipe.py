"""Our own pictures of a visit for a page without a server: the scene before it and after, to wipe between."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import torch

from refield.field.render import render_camera
from refield.report.pictures import data_uri
from refield.scene.capture import Frame
from refield.scene.change import SceneChange
from refield.scene.pose import invert, transform
from refield.view.scenery import Scenery

_PIXELS = 480 * 480  # of a picture, about and at most


def wipe(scenery: Scenery, visit: int) -> str:
    """What a visit changed, from the place of a photo that shows it well, as HTML; empty if it changed nothing.

    Raises:
        InputError: a field cannot be read.
    """
    change = scenery.changes[visit - 1]
    if not change.objects:
        return ""
    frame = best_view(change.frames or scenery.capture.frames, change)
    camera = frame.camera.within(_PIXELS)
    sources = []
    for state in (visit - 1, visit):
        with scenery.turns.first():
            sources.append(data_uri(render_camera(scenery.field(state), camera, frame.world_from_cam).rgb))
    name = escape(f"Visit {visit}: before and after")
    shown = zip(("before", "after"), sources)
    pictures = "".join(f'<img class="{when}" alt="{name}: {when}" src="{source}">' for when, source in shown)
    slider = f'<input type="range" min="0" max="100" value="50" aria-label="{name}">'
    shape = f"--at:50%;aspect-ratio:{camera.width}/{camera.height}"
    return f'<figure class="wipe" style="{shape}"><div>{pictures}</div>{slider}</figure>'


def best_view(frames: Sequence[Frame], change: SceneChange) -> Frame:
    """The frame that shows most corners of what changed, where it was and where it is; of several the first."""
    corners = []
    for o in change.objects:
        box = torch.cartesian_prod(*o.grid.tight_aabb().double().T)
        corners += [box] if o.new_from_old is None else [box, transform(o.new_from_old.double(), box)]
    points = torch.cat(corners)

    def shown(frame: Frame) -> int:
        pixels, depth = frame.camera.project(transform(invert(frame.world_from_cam.double()), points))
        return int(frame.camera.shows(pixels, depth).sum())

    return max(frames, key=shown)
