"""A visit with everything that a report can hold, made by hand: three objects, photos of them, a rejected one."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import torch

from refield.report import Comparison, VisitReport
from refield.scene import pose
from refield.scene.camera import Camera
from refield.scene.capture import Frame
from refield.scene.change import ObjectChange, OccupancyGrid, PlacedPhoto, SceneChange
from refield.scene.world import World

EVIL = "<script>alert('&\"x')</script>"
WORLD = World(up=(0.0, -1.0, 0.0), size=10.0, metres_per_unit=0.4)
"""photographed along z with y down"""
CAMERA = Camera(60, 40, 40.0, 40.0, 30.0, 20.0)
RED, GREEN, BLUE = ((1.0, 0.1, 0.1), (0.1, 0.8, 0.1), (0.2, 0.2, 0.9))


def box(x: float) -> OccupancyGrid:
    """1.25 long, 0.75 high and 1 deep (with half a cell around it), 6 before the camera."""
    centre = torch.tensor([x, 0.0, 6.0])
    half = torch.tensor([0.5, 0.3, 0.4])
    return OccupancyGrid(torch.stack([centre - half, centre + half]), torch.ones(5, 5, 5))


def moved(x: float = -2.0, by: float = 1.0, degrees: float = 30.0) -> ObjectChange:
    """To the right as the camera sees it, and turned about its own middle; anticlockwise about y, which points down."""
    there, back = torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
    there[:3, 3] = torch.tensor([x + by, 0.0, 6.0])
    back[:3, 3] = torch.tensor([-x, 0.0, -6.0])
    turn = pose.exp(torch.tensor([0, 0, 0, 0, math.radians(degrees), 0], dtype=torch.float64))
    sure = torch.eye(6, dtype=torch.float64) * 1e-8
    return ObjectChange("moved", box(x), there @ turn @ back, confidence=0.93, covariance=sure, note="it fits there")


def objects() -> tuple[ObjectChange, ...]:
    """One of each kind."""
    return (
        moved(),
        ObjectChange("removed", box(1.0), confidence=0.7, note=EVIL),
        ObjectChange("added", box(2.6), confidence=0.4),
    )


def frame(name: str, x: float = 0.0) -> Frame:
    world_from_cam = torch.eye(4, dtype=torch.float64)
    world_from_cam[0, 3] = x
    return Frame(Path(name), CAMERA, name, world_from_cam)


def plain(colour: tuple[float, float, float]) -> torch.Tensor:
    return torch.tensor(colour).expand(CAMERA.height, CAMERA.width, 3).clone()


def view(name: str, x: float = 0.0, *, marked: bool = True) -> Comparison:
    """The old field shows red, the updated one green, the photo is blue."""
    masks = torch.zeros(3, CAMERA.height, CAMERA.width, dtype=torch.bool)
    masks[0, 14:26, 18:28], masks[1, 14:26, 8:18], masks[2, 2:6, 2:6] = True, True, True
    pictures = plain(BLUE), plain(RED), plain(GREEN)
    wall = torch.full((CAMERA.height, CAMERA.width), 6.0)
    out = Comparison(name, *pictures, *(masks if marked else ()), frame=frame(name, x))  # type: ignore[arg-type, misc]
    return replace(out, depth_before=wall, depth_after=wall)


def visit_report(world: World | None = WORLD, number: int | None = 2) -> VisitReport:
    used = [PlacedPhoto(n, "used", frame=frame(n, x)) for n, x in (("images/a.png", 0.0), ("images/b.png", 0.5))]
    photos = (*used, PlacedPhoto(EVIL, "rejected", "only 7 inliers"))
    unclear = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
    change = SceneChange(objects(), photos, why=f"because {EVIL}", unexplained=(unclear, unclear))
    scores = {"psnr": 30.0, "psnr_in": 27.123, "psnr_out": None, "ssim_in": 0.912}
    old = {"psnr": 25.0, "psnr_in": 12.5, "psnr_out": None, "ssim_in": 0.999}
    told = {"pooled": scores, "mean": scores, "pooled_before": old, "mean_before": old}
    told["views"] = [{"name": EVIL, "scores": scores, "before": old}]  # type: ignore[assignment]
    return VisitReport(
        title=f"kitchen {EVIL}, visit 2",
        change=change,
        photos=(view("images/a.png"), view("images/b.png", 0.5), Comparison(EVIL, None)),
        seconds={"detect": 1.25, "fit a field to 63 photos": 20.0, EVIL: 3.5},
        evaluation=told,
        evaluation_views=(view(EVIL, marked=False),),
        facts={"held-out PSNR": 31.234, EVIL: EVIL},
        warnings=(f"part of it {EVIL}",),
        world=world,
        number=number,
        made=datetime(2026, 3, 7, 9, 5, tzinfo=UTC),
        old_frames=tuple(frame(f"old{i}", 0.3 * i) for i in range(5)),
    )
