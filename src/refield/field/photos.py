"""What a fit learns from and is judged by: a capture's photos, and what has become known of the scene since."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from refield.field.coverage import knowable
from refield.field.kernels.reference import BURNT
from refield.field.pixels import PixelBank, Pixels
from refield.field.radiance import Field
from refield.field.render import render_many
from refield.field.sampling import OccupancySampler
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame, Rays, camera_rays
from refield.scene.change import OccupancyGrid


@dataclass(frozen=True)
class Since:
    """What is known of the scene since its capture was taken: for a fit to the scene as it is now."""

    frames: tuple[Frame, ...] = ()
    """photos taken since; all of their pixels teach, and none is held out"""
    valid: Mapping[str, Tensor] = field(default_factory=dict)
    """name of a frame of the capture, or of those carried -> (H, W) bool: its pixels that show the scene as it is; all,
    for those not named"""
    carried: tuple[Frame, ...] = ()
    """older photos of something that moved, from where they would have been taken now; none is held out"""
    share: float | None = None
    """of each step's rays drawn from ``frames``; None: all pixels alike, old and new"""
    empty: tuple[OccupancyGrid, ...] = ()
    """what is known to hold nothing any more"""


UNCHANGED = Since()


@dataclass(frozen=True)
class Photos:
    """What a fit learns from, and what it is judged by."""

    train: tuple[Frame, ...]
    held_out: tuple[Frame, ...]
    taught: tuple[Tensor | None, ...]
    """per training frame, (H, W) bool: the pixels that teach; None: all"""
    judged: tuple[Tensor | None, ...]
    """the same of the held-out frames"""
    most: int | None = None
    """of more pixels so many are kept, drawn from every photo alike"""
    since: Since = UNCHANGED
    """whose photos are the last of those to train on"""

    @staticmethod
    def of(capture: Capture, since: Since = UNCHANGED, most: int | None = None) -> Photos:
        """Raises ValueError if there is nothing to learn from."""
        older, held = capture.train + since.carried, capture.held_out
        train = older + since.frames
        if not train:
            raise ValueError("the capture has no frame to train on")
        taught = *(since.valid.get(f.name) for f in older), *(None for _ in since.frames)
        if not any(mask is None or mask.any() for mask in taught):
            raise ValueError("no pixel of the capture is left to train on")
        return Photos(train, held, taught, tuple(since.valid.get(f.name) for f in held), most, since)

    def bank(self) -> PixelBank:
        """The pixels that teach."""
        return PixelBank(self.train, most=self.most, masks=self.taught)

    def judge(self) -> HeldOut:
        """The pixels that do not."""
        return HeldOut(self.held_out, masks=self.judged)

    def drawn(self, bank: Pixels, count: int) -> Tensor:
        """Indices (count,) of pixels of the bank, at random; of the photos taken since, the share that they are to
        have."""
        newer = int(bank.starts[len(self.train) - len(self.since.frames)])
        if self.since.share is None or newer in (0, len(bank)):
            return torch.randint(len(bank), (count,))
        new = round(count * self.since.share)
        return torch.cat([torch.randint(newer, (count - new,)), torch.randint(newer, len(bank), (new,))])

    def knowable(self, sampler: OccupancySampler) -> Tensor:
        """(R**3,) bool: cells that may hold something, by the cameras (`coverage.knowable`) and by what is known to
        hold nothing any more."""
        allowed = knowable(sampler, self.train)
        for grid in self.since.empty:
            cells = sampler.cells_in(grid.tight_aabb())
            allowed[cells[grid.contains(sampler.points_in(cells, jitter=False))]] = False
        return allowed


# dB. Left-out photos of four real scenes, as they are, gained -0.05 to 0.08 in seven fits; those of one scene with half
# a stop put on at random 0.51 to 0.71 in three
_CLEARLY = 0.25
_NOISE, _ROUNDS = 0.01, 12  # of a photo's colours; of weighted least squares


class HeldOut:
    """Fixed pixels of photos that training never sees."""

    def __init__(
        self,
        frames: tuple[Frame, ...],
        count: int = 16384,
        masks: Sequence[Tensor | None] | None = None,
    ) -> None:
        """``masks``: see `PixelBank`."""
        self.frames = frames
        self.rays: Rays | None = None
        if not frames:
            return
        bank = PixelBank(frames, most=count, masks=masks)
        if len(bank):
            chosen = torch.arange(len(bank))
            self.rays, self.truth, self.owner = bank.rays(chosen), bank.colours(chosen), bank.frame_of(chosen)
            self._places, self._basis = bank.place_of(chosen), bank.vignetting_basis(chosen, self.owner)
            self._fallen = torch.ones(len(bank), 1)
            width = torch.tensor([f.camera.width for f in frames])[self.owner]
            self.left: Tensor = self._places % width < width // 2
            """(P,) bool: pixels of the left halves of photos"""

    def learn(self, cameras: Sequence[Camera], vignetting: Tensor) -> None:
        """What has become known of the photos' lenses, of each one's as it is now, and of their vignetting (F, 3)."""
        if self.rays is None:
            return
        owner = self.owner.cpu()
        with torch.device("cpu"):
            directions = torch.empty(len(self._places), 3)
            for i, (frame, camera) in enumerate(zip(self.frames, cameras)):
                place = self._places[owner == i]
                pixels = torch.stack([place % camera.width, place // camera.width], -1) + 0.5
                directions[owner == i] = camera_rays(camera, frame.world_from_cam, pixels).directions
        self.rays = Rays(self.rays.origins, directions.to(self.rays.origins))
        self._fallen = (vignetting.cpu()[owner] * self._basis).sum(-1, keepdim=True).exp()

    def move(self, device: torch.device) -> None:
        """To where the field is that is judged."""
        if self.rays is not None:
            self.rays = Rays(self.rays.origins.to(device), self.rays.directions.to(device))
            self.truth, self.owner, self.left = (t.to(device) for t in (self.truth, self.owner, self.left))

    def psnr(self, model: Field, exposed: bool = False) -> float:
        """dB over the pixels; NaN if there are none. ``exposed``: the photos' exposures are not known: each one's is
        found by the pixels of its left half, and those of its right half judge."""
        if self.rays is None:
            return math.nan
        rgb = self._shown(model)
        return self._psnr_of(self._exposed(rgb), ~self.left) if exposed else self._psnr_of(rgb, None)

    def tells_exposures(self, model: Field) -> bool:
        """Whether the photos' right halves come out clearly better for exposures that their left halves tell: most
        photos', since what hangs before one of them would outweigh all others in their mean."""
        if self.rays is None:
            return False
        rgb = self._shown(model)
        before, after = self._right_halves(rgb), self._right_halves(self._exposed(rgb))
        seen = before > 0
        return bool(seen.any()) and float((10 * (before / after)[seen].log10()).median()) > _CLEARLY

    def _right_halves(self, rgb: Tensor) -> Tensor:
        """Mean squared error of each photo's right half, (F,); 0 without pixels there."""
        off = (rgb - self.truth).square().mean(-1)
        sums, counts = torch.zeros(2, len(self.frames), device=rgb.device).index_add_(
            1, self.owner, torch.stack([off, torch.ones_like(off)]) * ~self.left
        )
        return sums.clamp_min(1e-12 * (counts > 0)) / counts.clamp_min(1)

    def _exposed(self, rgb: Tensor) -> Tensor:
        return (rgb * self._gains(rgb, self.left)[self.owner]).clamp(0, 1)

    def _psnr_of(self, rgb: Tensor, of: Tensor | None) -> float:
        off = (rgb - self.truth).square()
        return -10 * math.log10(max(float((off if of is None else off[of]).mean()), 1e-12))

    def gains(self, model: Field) -> Tensor:
        """How each photo is exposed, by all of its pixels here, (F, 3); see `Exposure.gains`."""
        if self.rays is None:
            return torch.ones(0, 3)
        return self._gains(self._shown(model), torch.ones_like(self.left))

    def _shown(self, model: Field) -> Tensor:
        """As the photos show it, but for their gains."""
        if isinstance(model, nn.Module):
            model.eval()
        assert self.rays is not None
        return render_many(model, self.rays).rgb.clamp(0, 1).to(self.truth.device) * self._fallen.to(self.truth)

    def _gains(self, rgb: Tensor, asked: Tensor) -> Tensor:
        """By least absolute differences, as good as, over pixels that are asked and not burnt out, (F, 3); 1 where
        there are none. What the field shows wrongly in a part of a photo says nothing of the photo's exposure."""
        used = asked[:, None] & (self.truth < BURNT)
        gains = torch.ones(len(self.frames), 3, device=rgb.device)
        for _ in range(_ROUNDS):
            weight = used / (gains[self.owner] * rgb - self.truth).abs().clamp_min(_NOISE)
            both = torch.stack([rgb * self.truth, rgb * rgb]) * weight
            above, below = torch.zeros(2, len(self.frames), 3, device=rgb.device).index_add_(1, self.owner, both)
            gains = torch.where(below > 1e-6, above / below.clamp_min(1e-6), 1.0)
        return gains
