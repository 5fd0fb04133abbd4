"""A workspace of which every surface is known: a box on a slab under a far sky, kept as a hash field that is opaque in
exactly those cells."""

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from refield.field.encoding import Contraction
from refield.field.radiance import HashField, HashFieldConfig
from refield.field.render import render_camera
from refield.field.sampling import OccupancySampler
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from refield.scene.change import ObjectChange, OccupancyGrid, PlacedPhoto, SceneChange
from refield.scene.images import write_image
from refield.scene.pose import exp, invert, transform
from refield.scene.transforms_json import save_transforms
from refield.scene.world import World
from refield.workspace import Workspace
from tests.captures import ring

CAMERA = Camera(96, 72, 110.0, 110.0, 47.0, 36.5, k1=0.03, k2=-0.02, p1=0.001, p2=-0.0005)
CELLS = 128  # a side, of contracted space
CELL = 4 / CELLS
BOX = torch.tensor([[-0.25, -0.375, -0.25], [0.25, 0.375, 0.25]])
SLAB = torch.tensor([[-0.875, -0.875, -0.375], [0.875, 0.875, -0.25]])
WORLD = World((0.0, 0.0, 1.0), 6.0, 0.5)
NEW_FROM_OLD = exp(torch.tensor([0.3, -0.2, 0.0, 0.0, 0.0, 0.5], dtype=torch.float64))


def distance(x: Tensor) -> Tensor:
    """Signed distances (P,) of points (P, 3) to the box and the slab."""
    parts = []
    for low, high in (BOX, SLAB):
        q = (x - (low + high) / 2).abs() - (high - low) / 2
        parts.append(q.clamp_min(0).norm(dim=-1) + q.amax(-1).clamp_max(0))
    return torch.stack(parts).amin(0)


def solid_field() -> HashField:
    """Opaque in the cells of the box, of the slab and of the outermost of all space; of many colours."""
    centres = (torch.arange(CELLS) + 0.5) * CELL - 2
    x = torch.stack(torch.meshgrid(centres, centres, centres, indexing="ij"), -1)
    inside = (distance(x.reshape(-1, 3)) < 0).reshape(x.shape[:3])
    sky = x.abs().amax(-1) > 2 - CELL
    sampler = OccupancySampler(Contraction(torch.zeros(3), 1.0), (inside | sky).to(torch.uint8), 0.01)
    field = HashField(HashFieldConfig(levels=3, coarsest=8, finest=40, log2_table=14, width=8), sampler, 0)
    with torch.no_grad():
        field.encoding.tables.uniform_(0.5, 1.5, generator=torch.Generator().manual_seed(1))
        field.density_in.copy_(field.density_in.abs())
        field.density_out[0] = 50.0
        field.density_out[1:] = torch.randn(field.density_out[1:].shape, generator=torch.Generator().manual_seed(2))
        field.density_out[1:] -= field.density_out[1:].mean(1, keepdim=True)
    return field.eval().requires_grad_(False)


def frames_of(folder: Path, field: HashField, count: int, turn: float = 0.0) -> tuple[Frame, ...]:
    """Photos around the box, which are the field's own pictures."""
    frames = []
    for i, pose in enumerate(ring(count, turn)):
        name = f"images/{i:03d}.png"
        write_image(folder / name, render_camera(field, CAMERA, pose).rgb)
        frames.append(Frame(folder / name, CAMERA, name, pose))
    return tuple(frames)


def box_grid() -> OccupancyGrid:
    """The box and a margin of four nodes."""
    step, margin = 0.03125, 4 * 0.03125
    low, high = BOX[0] - margin, BOX[1] + margin
    shape = ((high - low) / step).round().long() + 1
    grid = OccupancyGrid(torch.stack([low, high]), torch.zeros(*shape.tolist()))
    x = grid.nodes()
    return replace(grid, values=((x >= BOX[0]) & (x <= BOX[1])).all(-1).float())


def make_workspace(folder: Path) -> Workspace:
    """``folder/work``: the field, and a visit that told of three things: the box moved to where it is, another one came
    there, a third left from there."""
    field = solid_field()
    capture = Capture(frames_of(folder / "data", field, 14), points=torch.tensor([[0.1, 0.2, 0.25]]))
    save_transforms(folder / "data", capture)
    with Workspace.building(folder / "work") as workspace:
        workspace.keep_capture(capture)
        workspace.keep_world(WORLD)
        workspace.keep_field(field, 30.0)
    workspace = Workspace.open(folder / "work")
    now = box_grid()
    old = now.moved(invert(NEW_FROM_OLD))
    old = replace(old, values=old.values.clamp(0, 1))
    photos = tuple(PlacedPhoto(f.name, "used", "", f) for f in frames_of(folder / "new", field, 2, turn=0.3))
    objects = (
        ObjectChange("moved", old, NEW_FROM_OLD, confidence=0.8, covariance=torch.eye(6, dtype=torch.float64) * 1e-6),
        ObjectChange("added", now, confidence=0.6, note="came"),
        ObjectChange("removed", now, confidence=0.4),
    )
    with workspace.writing(), workspace.new_visit() as part:
        workspace.keep_change(part, SceneChange(objects, photos, "so it was told"))
    return workspace


def corners(box: Tensor) -> Tensor:
    """Of a box (2, 3): (8, 3)."""
    return torch.cartesian_prod(*box.T)


def moved_corners(world_from_box: Tensor, size: Tensor) -> Tensor:
    """Of an oriented box."""
    half = torch.as_tensor(size, dtype=torch.float64) / 2
    return transform(torch.as_tensor(world_from_box, dtype=torch.float64), corners(torch.stack([-half, half])))
