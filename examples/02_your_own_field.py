"""Your own field: refield updates whatever has a density, a colour and a sampler (`refield.Field`).

Here a plain NeRF, written out in torch: positional encoding and five layers, no hash grid. It is fitted a little, a few
new photos are compared with it, and it is brought up to date. The update never looks inside, and does not change it.

Run: python examples/02_your_own_field.py [OUT [SCENE [STEPS]]]
SCENE is a folder with before/ and after/, photos with poses; by default the packaged one. STEPS of training: 1500 take
some minutes on two cores.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

import refield
from refield.field.placing import place_contraction
from refield.field.render import render_rays
from refield.field.sampling import OccupancySampler
from refield.scene.capture import Rays, camera_rays
from refield.scene.images import frame_image
from refield.synthetic import sample_folder

RAYS = 256  # a step
CELLS = 64  # a side of the grid that tells where to look


class PlainNerf(nn.Module):
    """A `refield.Field`: x, d → density and colour."""

    def __init__(self, sampler: OccupancySampler, width: int = 64, octaves: int = 4) -> None:
        super().__init__()
        self.sampler = sampler
        self.frequencies = math.pi / 2 * 2.0 ** torch.arange(octaves)
        size = 3 + 6 * octaves
        self.body = nn.Sequential(nn.Linear(size, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.to_density = nn.Linear(width, 1)
        self.to_colour = nn.Sequential(nn.Linear(width + 3, width), nn.ReLU(), nn.Linear(width, 3))

    def density(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> sigma (...,), per world unit."""
        return self.sigma(self.features(x))

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        """World points (..., 3) and unit directions (..., 3) -> sigma (...,) and rgb (..., 3) in [0, 1]."""
        features = self.features(x)
        return self.sigma(features), torch.sigmoid(self.to_colour(torch.cat([features, d], -1)))

    def features(self, x: Tensor) -> Tensor:
        """What is known of a place. The whole world is contracted into a cube; that is the field's own business."""
        y = self.sampler.contraction(x)
        angles = (y[..., None] * self.frequencies).flatten(-2)
        return self.body(torch.cat([y, angles.sin(), angles.cos()], -1))

    def sigma(self, features: Tensor) -> Tensor:
        """As instant-ngp has it, in units of the scene's size."""
        return self.to_density(features)[..., 0].clamp(max=12).exp() / self.sampler.contraction.radius


def fit(capture: refield.Capture, steps: int) -> PlainNerf:
    """A NeRF of the capture's training photos, by Adam on random rays."""
    torch.manual_seed(0)
    space = place_contraction(capture)
    everywhere = torch.ones(CELLS, CELLS, CELLS, dtype=torch.uint8)
    field = PlainNerf(OccupancySampler(space, everywhere, step=space.radius / 10, far=4.0))
    parts = [camera_rays(frame.camera, frame.world_from_cam) for frame in capture.train]
    rays = Rays(torch.cat([r.origins for r in parts]), torch.cat([r.directions for r in parts]))
    colours = torch.cat([frame_image(frame).reshape(-1, 3) for frame in capture.train]).float() / 255

    adam = torch.optim.Adam(field.parameters(), lr=1.5e-2)
    decay = torch.optim.lr_scheduler.ExponentialLR(adam, 0.05 ** (1 / steps))
    for step in range(steps):
        some = torch.randint(len(colours), (RAYS,))
        loss = functional.mse_loss(render_rays(field, rays[some], jitter=True).rgb, colours[some])
        adam.zero_grad()
        loss.backward()
        adam.step()
        decay.step()
        if step in (steps // 6, steps // 3, 2 * steps // 3, steps - 1):  # look where something is, and more closely
            found = OccupancySampler.from_density(field.density, space, field.sampler.step, CELLS)
            field.sampler = replace(found, step=space.radius / (24 if step < steps - 1 else 32), far=4.0)
            print(f"  step {step}: {-10 * loss.log10():.1f} dB on the rays that it learns from")
    return field.eval().requires_grad_(False)


def main(out: Path, scene: Path, steps: int) -> None:
    capture = refield.load_capture(scene / "before")
    field = fit(capture, steps)
    assert isinstance(field, refield.Field)

    photos = refield.load_new_photos(scene / "after", capture)
    change = refield.estimate_change(capture, field, photos, on_stage=print)
    print(change)
    updated = refield.update_field(capture, field, change, on_stage=print)
    for name, state in (("before", field), ("after", updated)):
        refield.write_image(out / f"{name}.png", refield.render_frame(state, photos[0]).rgb)
    print(f"pictures in {out}")


if __name__ == "__main__":
    given = sys.argv[1:]
    main(
        Path(given[0] if given else "own-field"),
        Path(given[1]) if given[1:] else sample_folder(),
        int(given[2]) if given[2:] else 1500,
    )
