"""What a fit will take of the machine's memory, known before any of it is taken."""

from __future__ import annotations

import os
from dataclasses import dataclass

from refield.field.fit import FitConfig, most_pixels
from refield.field.fit_nerfacto import NerfactoFitConfig
from refield.field.photo_size import as_read
from refield.field.photos import UNCHANGED
from refield.field.pixels import DIRECTIONS_MOST
from refield.field.render import CHUNK
from refield.field.sampling import RESOLUTION
from refield.scene.capture import Capture

_ROOM = 40  # samples a ray that the march makes room for, with what growing buffers take more


@dataclass(frozen=True)
class Memory:
    """Bytes, beside what the program with its compiled kernels takes (about 0.5 GB)."""

    photos: int
    """pixels that are kept, uint8"""
    rays: int
    """a direction per pixel of every distinct camera, up to a bound"""
    field: int
    """parameters, their gradients and moments; the occupancy grid and what is known of its cells"""
    work: int
    """the samples of a step, and of a chunk of a rendering"""

    @property
    def total(self) -> int:
        return self.photos + self.rays + self.field + self.work

    def __str__(self) -> str:
        parts = ((self.photos, "photos"), (self.rays, "rays"), (self.field, "field"), (self.work, "work"))
        return f"{_short(self.total)}: " + ", ".join(f"{name} {_short(n)}" for n, name in parts)


def memory_of(capture: Capture, config: FitConfig | NerfactoFitConfig) -> Memory:
    """What the fit of either architecture will take for this capture."""
    capture = as_read(capture, UNCHANGED, config.size)[0]
    pixels = sum(f.camera.width * f.camera.height for f in capture.train)
    most = most_pixels(config) if isinstance(config, FitConfig) else None
    photos = 3 * pixels if most is None or pixels <= most else 7 * most  # with its place in the photo
    distinct = 12 * sum(c.width * c.height for c in {f.camera for f in capture.train})
    shape = config.field
    tables = shape.levels * (1 << shape.log2_table) * 8
    a_step = config.samples if isinstance(config, FitConfig) else 3 * config.rays * config.field.samples
    cells = RESOLUTION**3 * (16 + 1 + 1 + 8 + 8 + 5 * 8 + 4)  # the latter of their parts
    sample = 3 * 8 * shape.levels + 40
    work = CHUNK * _ROOM * (8 * shape.levels + 28) + 2 * a_step * sample
    return Memory(photos, distinct if distinct <= DIRECTIONS_MOST else 0, 4 * tables + cells, work)


def memory_fault(needed: Memory) -> tuple[str, str] | None:
    """What is wrong and what to do, where a fit would take more than half of the machine's memory; else None."""
    there = machine_memory()
    if needed.total <= there / 2:
        return None
    what = f"its photos take {needed.photos / 1e9:.1f} GB of memory, of which there are {there / 1e9:.1f}"
    most = max((there / 2 - needed.total + needed.photos) / 1e9, 0.1)
    return what, f"give --fit.photo-memory {most:.1f} or less, or scale the photos down"


def machine_memory() -> int:
    """Bytes that this machine has."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _short(n: int) -> str:
    return f"{n / 1e9:.1f} GB" if n >= 1e9 else f"{n / 1e6:.0f} MB" if n >= 1e6 else f"{n / 1e3:.0f} kB"
