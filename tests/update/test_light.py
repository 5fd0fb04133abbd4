"""The light on unchanged surfaces: found where it changed, left alone where it did not."""

from __future__ import annotations

from dataclasses import replace

import torch

from refield.update.light import Relighting, Sightings, fit_light

BOX = torch.tensor([[-1.0, -1.0, -0.5], [1.0, 1.0, 0.5]])


def ground(factor: torch.Tensor | float, x: torch.Tensor, noise: float, seed: int = 0) -> Sightings:
    """Four views of a textured floor; the new photos are ``factor`` times as bright, and noisy."""
    g = torch.Generator().manual_seed(seed)
    texture = 0.45 + 0.25 * torch.sin(torch.tensor([17.0, 23.0, 31.0]) * x[:, :1] + 9 * x[:, 1:2])
    photo = (texture * factor + noise * torch.randn(len(x), 3, generator=g)).clamp(0, 1)
    return Sightings(x, photo, texture, torch.arange(len(x)) % 4)


def floor_points(n: int = 40_000) -> torch.Tensor:
    g = torch.Generator().manual_seed(1)
    x = torch.rand(n, 3, generator=g) * 2.6 - 1.3
    x[:, 2] = 0.01 * torch.randn(n, generator=g)
    return x


def gain_of(light: Relighting, x: torch.Tensor) -> torch.Tensor:
    """Factors (S, 3) at world points (S, 3)."""
    dim = torch.full_like(x, 0.25)
    return light.applied(x, dim) / dim


def test_light_is_laid_on_as_its_factors_say() -> None:
    """Compiled, and in torch where gradients are asked for: inside, outside and at the border of the box."""
    g = torch.Generator().manual_seed(2)
    light = Relighting(BOX, 0.4 * torch.randn(7, 5, 3, 3, generator=g))
    x = torch.cat([torch.rand(2000, 3, generator=g) * 2.6 - 1.3, BOX, torch.full((1, 3), torch.nan)])
    rgb = torch.rand(len(x), 3, generator=g)
    plainly = light.applied(x, rgb.clone().requires_grad_())
    kept = rgb.clone()
    torch.testing.assert_close(light.applied(x, rgb), plainly.detach(), atol=2e-6, rtol=0)
    assert torch.equal(rgb, kept), "what was given stays"
    assert torch.equal(plainly[-1].detach(), rgb[-1])


def test_a_shadow_is_found_and_only_there() -> None:
    x = floor_points()
    distance = (x[:, :2] - torch.tensor([0.2, -0.1])).norm(dim=-1)
    factor = torch.where(distance < 0.35, 0.5, 1.0)[:, None]
    light = fit_light(ground(factor, x, noise=0.03), BOX, spacing=0.06)
    assert light is not None
    gain = gain_of(light, x)
    assert float((gain[distance < 0.25] - 0.5).abs().mean()) < 0.05
    clear = (distance > 0.5) & (x.abs().amax(-1) < 0.9)
    assert float((gain[clear] - 1).abs().mean()) < 0.01
    outside = (x.abs() > BOX[1]).any(-1)
    assert torch.equal(gain[outside], torch.ones_like(gain[outside]))


def test_noise_is_not_light() -> None:
    x = floor_points()
    light = fit_light(ground(1.0, x, noise=0.05), BOX, spacing=0.06)
    assert light is None or float(light.log_gain.abs().max()) < 0.02


def test_what_only_one_photo_says_is_not_believed() -> None:
    x = floor_points()
    seen = ground(1.0, x, noise=0.02)
    dark = (seen.fold == 2) & ((x[:, :2]).norm(dim=-1) < 0.3)
    one_liar = Sightings(seen.x, torch.where(dark[:, None], 0.4 * seen.photo, seen.photo), seen.rendered, seen.fold)
    light = fit_light(one_liar, BOX, spacing=0.06)
    assert light is None or float((gain_of(light, x) - 1).abs().max()) < 0.05
    alone = seen[(seen.fold == 0).nonzero()[:, 0]]
    assert fit_light(alone, BOX, spacing=0.06) is None


def test_where_one_photo_alone_looks_its_patches_confirm_each_other() -> None:
    x = floor_points()
    distance = (x[:, :2] - torch.tensor([-0.5, 0.0])).norm(dim=-1)
    factor = torch.where(distance < 0.3, 0.5, 1.0)[:, None]
    left = (x[:, 0] < 0).long()  # where the first photo alone looks; the others see the rest

    def seen(factor: torch.Tensor | float) -> Sightings:
        return replace(ground(factor, x, noise=0.03), fold=torch.where(left > 0, 0, 1 + torch.arange(len(x)) % 3))

    unsure = fit_light(seen(factor), BOX, spacing=0.06)
    assert unsure is None or float((gain_of(unsure, x[distance < 0.2]) - 1).abs().mean()) < 0.05
    light = fit_light(seen(factor), BOX, spacing=0.06, patch=0.12)
    assert light is not None
    gain = gain_of(light, x)
    assert float((gain[distance < 0.2] - 0.5).abs().mean()) < 0.05
    clear = (distance > 0.45) & (x.abs().amax(-1) < 0.9)
    assert float((gain[clear] - 1).abs().mean()) < 0.01
    noise = fit_light(seen(1.0), BOX, spacing=0.06, patch=0.12)
    assert noise is None or float(noise.log_gain.abs().max()) < 0.02


def test_what_one_photo_says_against_others_is_not_believed_in_patches() -> None:
    x = floor_points()
    seen = ground(1.0, x, noise=0.02)
    dark = (seen.fold == 2) & (x[:, :2].norm(dim=-1) < 0.3)
    one_liar = replace(seen, photo=torch.where(dark[:, None], 0.4 * seen.photo, seen.photo))
    light = fit_light(one_liar, BOX, spacing=0.06, patch=0.12)
    assert light is None or float((gain_of(light, x) - 1).abs().max()) < 0.05


def test_applied_multiplies_inside_and_stays_in_range() -> None:
    light = Relighting(BOX, torch.full((4, 4, 4, 3), 0.7).log())
    x = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])
    rgb = torch.full((2, 3), 0.8)
    torch.testing.assert_close(light.applied(x, rgb), torch.tensor([[0.56] * 3, [0.8] * 3]))
    bright = Relighting(BOX, torch.full((4, 4, 4, 3), 3.0).log())
    assert float(bright.applied(x, rgb).max()) <= 1
