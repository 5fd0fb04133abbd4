"""Where the core goes follows from what a first look shows, and how fields descend."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from refield.field import fit
from refield.field.coverage import beside
from refield.field.descent import FADE_EVERY, TableAdam, fading
from refield.field.encoding import Contraction
from refield.field.fit import FitConfig, fit_field
from refield.field.placing import around, place_contraction, stand_outside
from refield.field.radiance import HashField, HashFieldConfig
from refield.field.sampling import OccupancySampler
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame

CORE = Contraction(torch.zeros(3), 1.0)


class Shell:
    """Everything further from the origin than a radius is opaque."""

    def __init__(self, radius: float) -> None:
        self.radius = radius
        self.sampler = OccupancySampler(CORE, torch.ones(16, 16, 16, dtype=torch.uint8), 0.02)

    def density(self, x: Tensor) -> Tensor:
        return 1e3 * (x.norm(dim=-1) > self.radius).float()

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        return self.density(x), torch.full_like(x, 0.5)


def looking(at: float, count: int = 12) -> tuple[Frame, ...]:
    """Cameras in a ring of radius ``at``, which look through its centre; at 0, outwards."""
    frames = []
    for i in range(count):
        turn = 2 * math.pi * i / count
        forward = torch.tensor([-math.cos(turn), -math.sin(turn), 0.0], dtype=torch.float64)
        down = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.stack([torch.linalg.cross(down, forward), down, forward], -1)
        pose[:3, 3] = -at * forward
        frames.append(Frame(Path(f"{i}.png"), Camera(32, 32, 30.0, 30.0, 16.0, 16.0), f"{i}.png", pose))
    return tuple(frames)


def test_walls_around_the_cameras_are_taken_into_the_core() -> None:
    """All that is seen is 2.5 away; in the cube's measure, three quarters of it are nearer than that."""
    core = around(CORE, Shell(2.5), looking(0.5))
    assert 2.0 < core.radius <= 2.5 and core.centre is CORE.centre
    assert around(CORE, Shell(30.0), looking(0.5)).radius == 4.0
    assert around(CORE, Shell(0.8), looking(0.5)).radius == 1.0
    assert around(CORE, Shell(math.inf), looking(0.5)) == CORE  # nothing is seen


def test_cameras_in_a_larger_core_do_not_stand_around_it() -> None:
    ring = looking(1.67)
    assert stand_outside(CORE, ring) and not stand_outside(replace(CORE, radius=2.0), ring)


def test_cells_right_beside_a_camera_are_told_from_others() -> None:
    sampler, ring = Shell(1.0).sampler, looking(1.67)
    cells = beside(sampler, ring)
    x = sampler.points_in(torch.arange(sampler.grid.numel()), jitter=False)
    away = torch.cdist(x, torch.stack([f.centre.float() for f in ring])).amin(-1)
    assert cells.any() and away[cells].max() < 1.0 and not cells[x.norm(dim=-1) < 0.9].any()


def test_a_fit_looks_around_where_it_is_asked_to(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    image = tmp_path / "grey.png"
    Image.fromarray(np.full((32, 32, 3), 128, np.uint8)).save(image)
    capture = Capture(tuple(replace(f, path=image) for f in looking(2.0)))
    monkeypatch.setattr(fit, "around", lambda core, first, frames: replace(core, radius=2 * core.radius))
    monkeypatch.setattr(fit, "_FIRST_LOOK", replace(fit._FIRST_LOOK, steps=2))
    config = FitConfig(steps=4, samples=1024, field=HashFieldConfig(log2_table=12))
    usual, wide = (fit_field(capture, replace(config, look_around=how)) for how in (None, True))
    assert usual.contraction.radius == place_contraction(capture).radius
    assert wide.contraction.radius == pytest.approx(2 * usual.contraction.radius)


def test_entries_fade_that_no_ray_asks_for() -> None:
    def after(decay: float) -> Tensor:
        model = HashField(HashFieldConfig(levels=4, log2_table=8), Shell(1.0).sampler, 0)
        model.encoding.tables.data.fill_(0.5)
        adam = TableAdam(model, decay)
        for _ in range(2 * FADE_EVERY):
            assert adam.step(1e-2, 1.0)
        return model.encoding.tables.detach()

    assert torch.equal(after(0.0), torch.full_like(after(0.0), 0.5))
    torch.testing.assert_close(after(1.0), torch.full_like(after(0.0), 0.5 * fading(1.0, 1e-2) ** 2))


@pytest.mark.parametrize("part", [1.0, 0.25])
def test_networks_learn_at_a_part_of_the_tables_rate(part: float) -> None:
    model = HashField(HashFieldConfig(levels=4, log2_table=8), Shell(1.0).sampler, 0)
    adam = TableAdam(model, networks=part)
    before = [p.detach().clone() for p in adam.parameters]
    for grad in adam.grads:
        grad.fill_(1.0)
    assert adam.step(1e-2, 1.0)
    for k, (was, now) in enumerate(zip(before, adam.parameters)):
        wanted = torch.full_like(was, 1e-2 * (part if k else 1))
        torch.testing.assert_close(was - now.detach(), wanted, rtol=1e-3, atol=1e-6)
