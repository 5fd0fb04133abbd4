"""Rendering any field: closed forms, chunks, gradients, the sampler's promises."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from refield.field.encoding import Contraction
from refield.field.radiance import Field
from refield.field.render import render_camera, render_many, render_rays
from refield.field.sampling import OccupancySampler
from refield.field.volrend import Samples, composite
from refield.scene.camera import Camera
from refield.scene.capture import Rays, camera_rays
from refield.scene.pose import exp

SPACE = Contraction(torch.tensor([0.1, 0.0, -0.1]), 1.0)


class Box:
    """Constant density and colour in a box, nothing outside."""

    def __init__(self, half: float, sigma: float) -> None:
        self.half, self.sigma = half, sigma
        self.sampler = OccupancySampler.from_density(self.density, SPACE, step=0.005, resolution=64)

    def density(self, x: Tensor) -> Tensor:
        return torch.where(x.abs().amax(-1) < self.half, self.sigma, 0.0)

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        return self.density(x), torch.tensor([0.2, 0.5, 0.8]).expand(*x.shape)


def towards_origin(n: int) -> Rays:
    origins = normalize(torch.randn(n, 3), dim=-1) * 3
    return Rays(origins, normalize(torch.randn(n, 3) * 0.1 - origins, dim=-1))


def test_constant_density_has_its_closed_form() -> None:
    torch.manual_seed(0)
    box = Box(0.5, 4.0)
    assert isinstance(box, Field)
    rays = towards_origin(300)
    inverse = 1 / rays.directions
    a, b = (-0.5 - rays.origins) * inverse, (0.5 - rays.origins) * inverse
    enter, leave = torch.minimum(a, b).amax(-1), torch.maximum(a, b).amin(-1)
    length = (leave - enter).clamp_min(0)
    out = render_many(box, rays)
    torch.testing.assert_close(out.opacity, 1 - torch.exp(-4.0 * length), rtol=0, atol=0.03)
    torch.testing.assert_close(out.rgb, out.opacity[:, None] * torch.tensor([0.2, 0.5, 0.8]))
    long = length > 0.3
    tau = 4.0 * length
    mean = enter + 0.25 * (1 - torch.exp(-tau) * (1 + tau)) / (1 - torch.exp(-tau))
    torch.testing.assert_close(out.depth[long], mean[long], rtol=0, atol=0.05)  # cells cut by a face are partly lost


def test_chunks_and_views_agree_with_rays() -> None:
    torch.manual_seed(1)
    box = Box(0.4, 30.0)
    camera = Camera(24, 16, 20.0, 20.0, 12.0, 8.0)
    pose = exp(torch.tensor([0.0, 0, -2, 0.1, 0.2, 0.3], dtype=torch.float64))
    view = render_camera(box, camera, pose, chunk=50)
    whole = render_rays(box, camera_rays(camera, pose))
    assert view.rgb.shape == (16, 24, 3)
    torch.testing.assert_close(view.rgb.reshape(-1, 3), whole.rgb)
    torch.testing.assert_close(view.depth.reshape(-1), whole.depth)


def test_rays_that_miss_everything_are_black_and_empty() -> None:
    away = Rays(torch.tensor([[5.0, 0, 0]]).expand(4, 3), torch.tensor([[1.0, 0, 0]]).expand(4, 3).contiguous())
    out = render_many(Box(0.5, 10.0), away)
    assert out.rgb.abs().max() == 0 and out.opacity.max() == 0 and out.depth.max() == 0


def test_refreshing_a_box_of_the_grid_sees_what_changed_there_and_nothing_else() -> None:
    before, after = Box(0.3, 20.0), Box(0.6, 20.0)
    patch = torch.tensor([[0.3, -0.7, -0.7], [0.7, 0.7, 0.7]])
    grid = before.sampler.refreshed(after.density, [patch])
    probe = torch.rand(20_000, 3) * 1.6 - 0.8
    inside = ((probe > patch[0] + 0.02) & (probe < patch[1] - 0.02)).all(-1)
    outside = ((probe < patch[0] - 0.2) | (probe > patch[1] + 0.2)).any(-1)
    wanted = after.sampler.occupied(probe)
    assert (grid.occupied(probe)[inside] == wanted[inside]).float().mean() > 0.95  # but for cells that the surface cuts
    assert torch.equal(grid.occupied(probe)[outside], before.sampler.occupied(probe)[outside])


def test_cells_and_points_agree() -> None:
    sampler = Box(0.5, 1.0).sampler
    cells = torch.randint(64**3, (5000,))
    y = sampler.contraction(sampler.points_in(cells, jitter=False)).abs().amax(-1)
    near = y < 1.9  # the outermost cells reach to infinity, where float32 cannot come back from
    assert torch.equal(sampler.cells(sampler.points_in(cells, jitter=False))[near], cells[near])


def test_contraction_keeps_the_core_and_bounds_the_rest() -> None:
    x = torch.tensor([[0.1, 0.0, -0.1], [1.1, 0.0, -0.1], [1e6, 0.0, 0.0]])
    y = SPACE(x)
    torch.testing.assert_close(y[0], torch.zeros(3))
    torch.testing.assert_close(y[1], torch.tensor([1.0, 0, 0]))
    assert math.isclose(float(y[2, 0]), 2.0, abs_tol=1e-4)


def test_a_trace_of_light_does_not_move_a_surface_to_the_background() -> None:
    """By hand: a ray of which all but 2 % is stopped at 1, the rest by a background that goes on for ever; and one that
    meets but the background."""
    samples = Samples(torch.tensor([0.95, 1.05, 1.0]), torch.tensor([1.05, 900.0, 3.0]), torch.tensor([0, 2, 3]))
    sigmas = torch.tensor([-math.log(0.02) / 0.1, 60.0, 60.0])
    out = composite(sigmas, torch.ones(3, 3), samples)
    torch.testing.assert_close(out.depth, torch.tensor([1.0, 2.0]))
    torch.testing.assert_close(out.opacity, torch.ones(2))
