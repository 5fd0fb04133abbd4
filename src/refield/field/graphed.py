"""One step of fitting, of fixed shape, so that a CUDA graph can hold it: nothing is asked of the device.

On a GPU a step is some hundred small launches; captured once and replayed they cost one. The same code also runs step
by step, on any device that the GPU kernels run on.

Letters: P pixels of F photos, N rays a step, S samples of room.
"""

from __future__ import annotations

import torch
from torch import Tensor

from refield.field.kernels import gpu
from refield.field.kernels.reference import Aim, Lattice, Space, Stepped
from refield.field.photo_model import Asked, PhotoModel
from refield.field.pixels import PixelBank
from refield.field.placing import COLOUR_IN, DIRECTED
from refield.field.radiance import HashField
from refield.scene.capture import Rays
from refield.scene.exposure import vignetting_basis

_WARM = 3  # steps before a capture: kernels are compiled and workspaces allocated in them


class DevicePixels:
    """A `PixelBank` on a device: rays and colours by table look-ups alone, whatever cameras the pixels belong to."""

    def __init__(self, bank: PixelBank, device: torch.device) -> None:
        self.frames = bank.frames
        cameras = list(dict.fromkeys(f.camera for f in bank.frames))
        camera_of = torch.tensor([cameras.index(f.camera) for f in bank.frames])
        tables = [c.unproject(c.pixel_centres()).float() for c in cameras]
        begins = torch.tensor([0, *(len(t) for t in tables)]).cumsum(0)
        self._count = len(bank)
        self._rgb, self.starts = bank.rgb.to(device), bank.starts.to(device)
        self._places = None if bank.places is None else bank.places.to(device)
        self._directions = torch.cat(tables).to(device)  # of every pixel of every distinct camera, in camera axes
        self._begins = begins[camera_of].to(device)
        self._sizes = torch.tensor([(c.width, c.height) for c in cameras])[camera_of].to(device)
        self._rotations = torch.stack([f.world_from_cam[:3, :3] for f in bank.frames]).float().to(device)
        self._centres = torch.stack([f.centre for f in bank.frames]).float().to(device)

    def __len__(self) -> int:
        return self._count

    def frame_of(self, pixels: Tensor) -> Tensor:
        """Index of the frame that owns each pixel, (B,) -> (B,)."""
        return torch.searchsorted(self.starts, pixels, right=True) - 1

    def rays(self, pixels: Tensor) -> Rays:
        """World rays through pixel centres, (B,) -> Rays of B."""
        owner = self.frame_of(pixels)
        d = self.camera_directions(pixels, owner)
        return Rays(self._centres[owner], (self._rotations[owner] * d[:, None, :]).sum(-1))

    def place_of(self, pixels: Tensor) -> Tensor:
        """Each pixel's place in its photo, row by row, (B,) -> (B,) int64."""
        return self._place_of(pixels, self.frame_of(pixels))

    def _place_of(self, pixels: Tensor, owner: Tensor) -> Tensor:
        return pixels - self.starts[owner] if self._places is None else self._places[pixels].long()

    def camera_directions(self, pixels: Tensor, owner: Tensor) -> Tensor:
        """Unit directions in camera axes through the centres of pixels (B,) of photos ``owner`` (B,), (B, 3)."""
        return self._directions[self._begins[owner] + self._place_of(pixels, owner)]

    def vignetting_basis(self, pixels: Tensor, owner: Tensor) -> Tensor:
        """`refield.scene.exposure.vignetting_basis` at pixels (B,) of photos ``owner`` (B,), (B, 3)."""
        place, size = self._place_of(pixels, owner), self._sizes[owner]
        return vignetting_basis(torch.stack([place % size[:, 0], place // size[:, 0]], -1) + 0.5, size)

    def colours(self, pixels: Tensor) -> Tensor:
        """(B,) -> (B, 3) float32 in [0, 1]."""
        return self._rgb[pixels].float() / 255


class Descent:
    """`descent.TableAdam` on a device: rate, count and the guard against bad steps are tensors.

    A step whose loss or gradient is not finite leaves everything as it was; ``bad`` counts such steps in a row.
    """

    def __init__(self, model: HashField, networks: float = 1.0) -> None:
        """``networks``: their learning rate, as a part of the tables'."""
        self.tables, self.networks = model.encoding.tables, model.networks
        self._slower = networks
        self._parameters = [self.tables, *self.networks]
        device = self.tables.device
        self.rate = torch.zeros((), device=device)
        self.count = torch.zeros((), dtype=torch.int64, device=device)
        self.bad = torch.zeros((), dtype=torch.int64, device=device)
        sizes = [w.numel() for w in self.networks]
        self._grads = torch.zeros_like(self.tables), torch.zeros(sum(sizes), device=device)
        parts = [g.view_as(w) for g, w in zip(self._grads[1].split(sizes), self.networks)]
        self.into = [self._grads[0], *parts]
        """where a step adds its gradients: the tables', the five matrices'"""
        self._first, self._second = ([torch.zeros_like(p) for p in self._parameters] for _ in range(2))

    @torch.no_grad()
    def step(self, loss: Tensor) -> Tensor:
        """Follow the gradients in ``into``, clear them, and say whether all was finite, () bool."""
        # a gradient that is not finite shows in the networks', through which all of it has gone
        good = torch.isfinite(loss) & torch.isfinite(self._grads[1]).all()
        self.bad.add_(1).mul_(~good)
        self.count.add_(good)
        for grad in self._grads:
            grad.masked_fill_(~good, 0)  # what has no gradient rests
        scale = gpu.adam_scale(self.rate, self.count.clamp_min(1), self.tables.device)
        scales = [scale, *[self._slower * scale] * len(self.networks)]
        for parts in zip(self._parameters, self.into, self._first, self._second, scales):
            gpu.descend(*parts)
        return good


class GraphedStep:
    """Draw N pixels, march, evaluate, composite, compare, descend, and note what was seen where.

    Grid and occupancy state are read and written in place at every replay; ``descent.rate`` and ``now`` may be set
    between replays, and what ``photos`` know may change in place. The lattice is part of the graph, and so is the
    stage of the fit at which the photos are asked (`PhotoModel.stage`).
    """

    def __init__(
        self,
        descent: Descent,
        photos: PhotoModel,
        where: tuple[Space, Tensor, Lattice, tuple[int, ...]],
        aim: Aim,
        occupancy: tuple[Tensor, float],
        size: tuple[int, int],
    ) -> None:
        """``photos`` have `DevicePixels`; ``where``: space, grid (R, R, R) uint8, lattice, levels; ``occupancy``: see
        `reference.observe`, state and decay; ``size``: N and S."""
        self.descent, self.photos, self.where, self.aim, self.occupancy = descent, photos, where, aim, occupancy
        self.progress = 0.0
        """of the fit, in [0, 1]; heeded when the step is captured"""
        self.plain = False
        """whether colours do not learn from where they are seen; heeded likewise"""
        self.asked: Asked | None = None
        self.found: Stepped | None = None
        """what the last step looked at, and what it found: where replays write it; nothing, of a step left out"""
        self.rays, self.capacity = size
        self._device = descent.tables.device
        self.now = torch.ones((), device=self._device)
        """the round of the occupancy"""
        self.loss = torch.zeros((), device=self._device)
        self.samples = torch.zeros((), dtype=torch.int64, device=self._device)
        """that the last step used; as many as there is room for if it needed more"""
        self._graph: torch.cuda.CUDAGraph | None = None

    def run_eager(self) -> None:
        """One step, launch by launch."""
        space, grid, lattice, resolutions = self.where
        chosen = torch.randint(len(self.photos.bank), (self.rays,), device=self._device)
        self.asked = self.photos.ask(chosen, self.progress)
        field = (self.descent.tables, resolutions, self.descent.networks)
        into, capacity = self.descent.into, self.capacity
        found = gpu.train_step(self.asked.batch, space, grid, lattice, field, self.aim, into, capacity=capacity)
        if self.plain:
            into[COLOUR_IN][:, -DIRECTED:] = 0
        loss: Tensor = found.loss  # type: ignore[assignment]
        good = self.descent.step(loss)
        self.found = _taught(found, good)
        state, decay = self.occupancy
        gpu.observe(state, self.now, decay, found.cells, torch.where(good, found.weights, -1.0), found.sigmas)
        self.loss.copy_(loss)
        self.samples.copy_((found.weights >= 0).sum())

    def capture(self) -> int:
        """Hold the step in a graph, after a few real steps on a stream of their own; returns how many those were."""
        stream = torch.cuda.Stream(self._device)
        stream.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(stream):
            for _ in range(_WARM):
                self.run_eager()
        torch.cuda.current_stream(self._device).wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self.run_eager()
        return _WARM

    def replay(self) -> None:
        """One step, as captured."""
        if self._graph is None:
            raise RuntimeError("the step was not captured: call capture() first")
        self._graph.replay()


def _taught(found: Stepped, good: Tensor) -> Stepped:
    """What a step found, for the photos to learn from: nothing, unless it was ``good`` () bool."""
    assert found.shown is not None and found.errors is not None and found.heaviest is not None
    to_rays = None
    if found.to_rays is not None:
        to_rays = torch.where(good, found.to_rays[0], 0.0), torch.where(good, found.to_rays[1], 0.0)
    return found._replace(
        shown=torch.where(good, found.shown, 0.0),
        errors=torch.where(good, found.errors, 0.0),
        heaviest=torch.where(good, found.heaviest, -1),
        to_rays=to_rays,
    )
