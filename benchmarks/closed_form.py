"""A capture without a path tracer: a world of textured solids, photographed by formula on whatever device there is.

Colours are the textures themselves, without light; four rays a pixel, so that edges are smooth. Beyond the solids it
is black.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor
from torch.nn import functional

from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from refield.scene.pose import invert, rotate, transform
from refield.scene.transforms_json import load_transforms, save_transforms
from refield.synthetic.cameras import hemisphere, square_camera
from refield.synthetic.state import State
from refield.synthetic.worlds import WORLDS

_WITHIN = ((-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25))  # a pixel's rays, from its centre


def closed_form_capture(folder: Path, world: str, size: int, cameras: int, device: torch.device) -> Capture:
    """The world's old photos; made once and kept in ``folder``. Every tenth is held out."""
    if not (folder / "transforms.json").is_file():
        made = WORLDS[world](0)
        photograph(folder, made.before, square_camera(size), hemisphere(cameras, made.target), device)
    return load_transforms(folder, decode=False)


def photograph(
    folder: Path, state: State, camera: Camera, poses: Sequence[Tensor], device: torch.device
) -> tuple[Frame, ...]:
    """Write ``folder/images`` and, at the end, ``folder/transforms.json``."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    names = [f"images/{i:04d}.bmp" for i in range(len(poses))]  # of all formats the fastest to read and write
    show = Photographer(state, camera, device)
    with ThreadPoolExecutor() as pool:
        written = []
        for name, pose in zip(names, poses):
            written.append(pool.submit(Image.fromarray(show(pose).numpy()).save, folder / name))
        for job in written:
            job.result()
    frames = tuple(Frame(folder / n, camera, n, p) for n, p in zip(names, poses))
    save_transforms(folder / "transforms.json", Capture(frames))
    return frames


class Photographer:
    """A state as one camera sees it."""

    def __init__(self, state: State, camera: Camera, device: torch.device) -> None:
        self._camera, self._device = camera, device
        centres = camera.pixel_centres()
        self._directions = [camera.unproject(centres + centres.new_tensor(w)).float().to(device) for w in _WITHIN]
        self._solids = [item.solid for item in state.items]
        self._poses = [invert(item.world_from_item).float().to(device) for item in state.items]
        self._textures = [torch.from_numpy(i.texture).float().permute(2, 0, 1)[None].to(device) for i in state.items]

    def __call__(self, world_from_cam: Tensor) -> Tensor:
        """The photo, (H, W, 3) uint8 on the CPU."""
        pose = world_from_cam.float().to(self._device)
        rgb = torch.stack([self._colours(pose, d) for d in self._directions]).mean(0)
        return (rgb.clamp(0, 1) * 255).round().to(torch.uint8).cpu().reshape(self._camera.height, -1, 3)

    def _colours(self, pose: Tensor, local: Tensor) -> Tensor:
        """Of the first surface along rays with directions (N, 3) in camera axes, (N, 3)."""
        directions = rotate(pose, local)
        origins = pose[:3, 3].expand_as(directions)
        own = [(transform(p, origins), rotate(p, directions)) for p in self._poses]
        depth, first = torch.stack([solid.hit(*rays) for solid, rays in zip(self._solids, own)]).min(0)
        rgb = torch.zeros_like(directions)
        for i, (o, d) in enumerate(own):
            mine = ((first == i) & depth.isfinite()).nonzero()[:, 0]
            uv = self._solids[i].uv(o[mine] + d[mine] * depth[mine, None])
            rgb[mine] = _looked_up(self._textures[i], uv)
        return rgb


def _looked_up(texture: Tensor, uv: Tensor) -> Tensor:
    """Bilinear, texel centres at (i + 0.5) / size. texture (1, 3, H, W), uv (K, 2) -> (K, 3)."""
    grid = (uv * 2 - 1)[None, None]
    found = functional.grid_sample(texture, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return found[0, :, 0].T
