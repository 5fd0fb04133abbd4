"""One step of fitting, of fixed shape, so that a CUDA graph can hold it: nothing is asked of the device.

On a GPU a step is some hundred small launches; captured once and replayed they cost one. The same code also runs step
by step, on any device that the GPU kernels run on.

Letters: P pixels of F photos, N rays a step, S samples of room.
"""

from __future__ import annotations

import torch
from torch import Tensor

from refield.field.kernels import gpu
from refield.field.kernels.reference import Aim, Batch, Lattice, Space
from refield.field.pixels import PixelBank
from refield.field.radiance import HashField
from refield.scene.capture import Rays

_WARM = 3  # steps before a capture: kernels are compiled and workspaces allocated in them


class DevicePixels:
    """A `PixelBank` on a device: rays and colours by table look-ups alone, whatever cameras the pixels belong to."""

    def __init__(self, bank: PixelBank, device: torch.device) -> None:
        cameras = list(dict.fromkeys(f.camera for f in bank.frames))
        tables = [c.unproject(c.pixel_centres()).float() for c in cameras]
        begins = torch.tensor([0, *(len(t) for t in tables)]).cumsum(0)
        self._count = len(bank)
        self._rgb, self._starts = bank.rgb.to(device), bank.starts.to(device)
        self._places = None if bank.places is None else bank.places.to(device)
        self._directions = torch.cat(tables).to(device)  # of every pixel of every distinct camera, in camera axes
        self._begins = begins[[cameras.index(f.camera) for f in bank.frames]].to(device)
        self._rotations = torch.stack([f.world_from_cam[:3, :3] for f in bank.frames]).float().to(device)
        self._centres = torch.stack([f.centre for f in bank.frames]).float().to(device)

    def __len__(self) -> int:
        return self._count

    def frame_of(self, pixels: Tensor) -> Tensor:
        """Index of the frame that owns each pixel, (B,) -> (B,)."""
        return torch.searchsorted(self._starts, pixels, right=True) - 1

    def rays(self, pixels: Tensor) -> Rays:
        """World rays through pixel centres, (B,) -> Rays of B."""
        owner = self.frame_of(pixels)
        local = pixels - self._starts[owner] if self._places is None else self._places[pixels]
        d = self._directions[self._begins[owner] + local]
        return Rays(self._centres[owner], (self._rotations[owner] * d[:, None, :]).sum(-1))

    def colours(self, pixels: Tensor) -> Tensor:
        """(B,) -> (B, 3) float32 in [0, 1]."""
        return self._rgb[pixels].float() / 255


class Descent:
    """`descent.TableAdam` on a device: rate, count and the guard against bad steps are tensors.

    A step whose loss or gradient is not finite leaves everything as it was; ``bad`` counts such steps in a row.
    """

    def __init__(self, model: HashField) -> None:
        self.tables, self.networks = model.encoding.tables, model.networks
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
        for parts in zip(self._parameters, self.into, self._first, self._second):
            gpu.descend(*parts, scale)
        return good


class GraphedStep:
    """Draw N pixels, march, evaluate, composite, compare, descend, and note what was seen where.

    Grid and occupancy state are read and written in place at every replay; ``descent.rate`` and ``now`` may be set
    between replays. The lattice is part of the graph.
    """

    def __init__(
        self,
        descent: Descent,
        pixels: DevicePixels,
        where: tuple[Space, Tensor, Lattice, tuple[int, ...]],
        aim: Aim,
        occupancy: tuple[Tensor, float],
        size: tuple[int, int],
    ) -> None:
        """``where``: space, grid (R, R, R) uint8, lattice, levels; ``occupancy``: see `reference.observe`, state and
        decay; ``size``: N and S."""
        self.descent, self.pixels, self.where, self.aim, self.occupancy = descent, pixels, where, aim, occupancy
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
        chosen = torch.randint(len(self.pixels), (self.rays,), device=self._device)
        rays = self.pixels.rays(chosen)
        jitter = torch.rand(self.rays, device=self._device)
        # what stays transparent is shown noise, so that only opaque surfaces explain the photos
        background = torch.rand(self.rays, 3, device=self._device)
        batch = Batch((rays.origins, rays.directions, jitter), self.pixels.colours(chosen), background)
        field = (self.descent.tables, resolutions, self.descent.networks)
        found = gpu.train_step(batch, space, grid, lattice, field, self.aim, self.descent.into, capacity=self.capacity)
        loss: Tensor = found.loss  # type: ignore[assignment]
        good = self.descent.step(loss)
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
