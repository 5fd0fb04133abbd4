"""The view that stands still, rendered by the field itself: coarse within a moment, then finer, until the camera moves.

Of each state that is shown the renderings of the present view are kept, so that a wipe costs nothing.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
import torch
from torch import Tensor

from refield.field.radiance import Field
from refield.field.render import render_many
from refield.field.volrend import Rendering
from refield.scene.camera import Camera
from refield.scene.capture import Rays, camera_rays
from refield.scene.errors import InputError
from refield.view.marks import IS, WAS
from refield.view.turns import Turns

Layer = Literal["sharp", "depth", "changed"]
PARTS = (0.15, 0.4, 1.0)  # of the screen's pixels a side, one after the other
_BAND = 24_576  # rays rendered between two looks at whether the camera moved
_MOST = 1_100_000  # pixels
_DIFFERS = 0.04  # a colour that differs by more between two states shows what changed
_NEARER = 0.01  # of a depth: what is closer by more stands before the rest
_INK = 0.5


@dataclass(frozen=True)
class Looking:
    """From where somebody looks at what."""

    camera: Camera
    world_from_cam: Tensor
    """(4, 4) float64"""
    now: int
    """the visit after which the state is shown"""
    before: int | None = None
    """the state to compare with, if any is asked for"""
    layer: Layer = "sharp"
    wipe: float = 0.0
    """the part of the picture, from its left, that shows how it was before"""

    @property
    def states(self) -> tuple[int, ...]:
        """Whose renderings it takes."""
        needed = self.before is not None and (self.wipe > 0 or self.layer == "changed")
        return (self.now, self.before) if needed and self.before is not None else (self.now,)

    def same_place(self, other: Looking) -> bool:
        """Whether it is the same view, perhaps of another state."""
        return self.camera == other.camera and torch.equal(self.world_from_cam, other.world_from_cam)


@dataclass(frozen=True)
class Picture:
    """What a standing view shows."""

    rgb: np.ndarray
    """(H, W, 3) uint8"""
    depth: np.ndarray
    """(H, W) float32 along the optical axis, world units; inf where nothing is"""


@dataclass
class StandingView:
    """Renders the view of one browser in a thread of its own, whenever it stands."""

    state: Callable[[int], Field]
    show: Callable[[Picture], None]
    turns: Turns
    rested: Callable[[], None] = lambda: None
    """hears that a picture is as fine as it gets"""
    rest: Callable[[], float] = lambda: 0.25
    """seconds without a move, after which a view stands"""
    _wanted: Looking | None = None
    _count: int = 0
    """of requests; whoever works for an earlier one stops"""
    _shown: int = -1
    """the request whose finest picture is shown"""
    _ended: bool = False
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _kept: dict[tuple[int, float], Rendering] = field(default_factory=dict)
    _place: Looking | None = None
    _thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to listen."""
        self._thread = threading.Thread(target=self._work, name="refield standing view")
        self._thread.start()

    def look(self, wanted: Looking | None) -> None:
        """Show this as soon as nothing else was asked for a moment; None: nothing."""
        with self._changed:
            self._wanted, self._count = wanted, self._count + 1
            self._changed.notify_all()

    @property
    def finest(self) -> bool:
        """Whether what was asked for last is shown as finely as it gets."""
        return self._shown == self._count

    def end(self) -> None:
        """Stop for good."""
        with self._changed:
            self._ended, self._count = True, self._count + 1
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()

    def _work(self) -> None:
        done = -1
        while not self._ended:
            with self._changed:
                self._await_other(done, None)
                wanted, done = self._wanted, self._count
                again = wanted is not None and self._place is not None and wanted.same_place(self._place)
                moved = not again and self._await_other(done, self.rest())
            if wanted is not None and not moved:
                with contextlib.suppress(InputError):  # of a visit that was taken back meanwhile
                    self._render(wanted, done)

    def _await_other(self, than: int, seconds: float | None) -> bool:
        """Whether another request than this comes; or the end."""
        return self._changed.wait_for(lambda: self._ended or self._count != than, seconds)

    def _render(self, wanted: Looking, request: int) -> None:
        if self._place is None or not wanted.same_place(self._place):
            self._kept, self._place = {}, wanted
        known = [p for p in PARTS if all((n, p) in self._kept for n in wanted.states)]
        for part in PARTS[PARTS.index(known[-1]) if known else 0 :]:
            camera = wanted.camera.within(_MOST).shrunk(part)
            for number in wanted.states:
                if (number, part) not in self._kept:
                    seen = self._seen(number, camera, wanted.world_from_cam, request)
                    if seen is None:
                        return
                    self._kept[number, part] = seen
            if self._count != request:
                return
            self.show(composed(wanted, camera, [self._kept[n, part] for n in wanted.states]))
        self._shown = request
        self.rested()

    def _seen(self, number: int, camera: Camera, world_from_cam: Tensor, request: int) -> Rendering | None:
        """A state's rendering; None if something else was asked for meanwhile."""
        with self.turns.first():
            shown = self.state(number)
        rays, parts = camera_rays(camera, world_from_cam), []
        device = shown.sampler.grid.device
        for i in range(0, len(rays), _BAND):
            if self._count != request:
                return None
            band = rays[i : i + _BAND]
            with self.turns.first():
                parts.append(render_many(shown, Rays(band.origins.to(device), band.directions.to(device))))
        return Rendering.joined(parts).reshape(camera.height, camera.width)


def composed(wanted: Looking, camera: Camera, seen: list[Rendering]) -> Picture:
    """The picture of a view: its layer, and the state before on the left of the wipe."""
    now, was = seen[0], seen[-1]
    shown = [_layer(wanted.layer, r, now, was) for r in (now, was)]
    depths = [_along_axis(r, camera) for r in (now, was)]
    edge = round(wanted.wipe * camera.width) if len(seen) > 1 else 0
    rgb = torch.cat([shown[1][:, :edge], shown[0][:, edge:]], 1)
    depth = torch.cat([depths[1][:, :edge], depths[0][:, edge:]], 1)
    if 0 < edge < camera.width:
        rgb[:, max(edge - max(camera.width // 400, 1), 0) : edge] = 1.0
    return Picture((rgb * 255).round().clamp(0, 255).to(torch.uint8).numpy(), depth.numpy())


def _layer(layer: Layer, shown: Rendering, now: Rendering, was: Rendering) -> Tensor:
    """(H, W, 3) float32 in [0, 1]."""
    if layer == "depth":
        return _depth_colours(shown)
    if layer == "sharp":
        return shown.rgb.cpu()
    left, came = changed(now, was)
    grey = shown.rgb.cpu().mean(-1, keepdim=True).expand(-1, -1, 3).clone()
    for mask, ink in ((left, WAS), (came, IS)):
        grey[mask] = (1 - _INK) * grey[mask] + _INK * torch.tensor(ink) / 255
    return grey


def changed(now: Rendering, was: Rendering) -> tuple[Tensor, Tensor]:
    """(H, W) bool each: pixels that look different, where something is farther off now than before or as far, and
    where something is nearer."""
    differs = (now.rgb - was.rgb).abs().amax(-1) > _DIFFERS
    nearer = now.surface(0.5) < was.surface(0.5) * (1 - _NEARER)
    return (differs & ~nearer).cpu(), (differs & nearer).cpu()


def _depth_colours(shown: Rendering) -> Tensor:
    """Near is red and far is blue, black where nothing is."""
    nearness = 1 / shown.surface(0.5).cpu().clamp_min(1e-9)
    there = nearness > 0
    if not bool(there.any()):
        return torch.zeros(*nearness.shape, 3)
    low, high = np.quantile(nearness[there].numpy(), [0.02, 0.98])
    steps = ((nearness - low) / max(high - low, 1e-12) * 255).clamp(0, 255).to(torch.uint8)
    colours = cv2.applyColorMap(steps.numpy(), cv2.COLORMAP_TURBO)[..., ::-1].astype(np.float32) / 255
    return torch.from_numpy(colours) * there[..., None]


def _along_axis(shown: Rendering, camera: Camera) -> Tensor:
    """(H, W) float32: depths along the optical axis, in place of those along the rays."""
    eye = torch.eye(4, dtype=torch.float64)
    cosine = camera_rays(camera, eye).directions[:, 2].reshape(camera.height, camera.width)
    return shown.surface(0.5).cpu() * cosine
