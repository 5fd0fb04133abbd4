"""The hot loops of the engine; every one has a plain-torch truth in `reference`, and twins in `cpu` (numba) and
`gpu` (Triton).

The twin is chosen by the device of the tensors. Set ``REFIELD_KERNELS=reference`` to run the truth everywhere.
"""

from __future__ import annotations

import os
from types import ModuleType

from torch import Tensor

from refield.field.kernels import onward, reference
from refield.field.kernels.onward import Lights, Shown, Span, Way
from refield.field.kernels.reference import (
    Aim,
    Batch,
    DensityNet,
    Fixed,
    Lattice,
    Networks,
    Rays3,
    Space,
    Stepped,
    Unwanted,
    Within,
)


def _twin(t: Tensor) -> ModuleType:
    if t.device.type not in ("cpu", "cuda") or os.environ.get("REFIELD_KERNELS") == "reference":
        return reference
    if t.device.type == "cuda":
        from refield.field.kernels import gpu

        return gpu
    from refield.field.kernels import cpu

    return cpu


def _further(t: Tensor) -> ModuleType:
    """The same, of what is in `onward`."""
    twin = _twin(t)
    return onward if twin is reference else twin


def contract(x: Tensor, centre: Tensor, radius: float) -> Tensor:
    """See `reference.contract`."""
    return _twin(x).contract(x, centre, radius)


def hash_encode(unit: Tensor, tables: Tensor, resolutions: tuple[int, ...]) -> Tensor:
    """See `reference.hash_encode`."""
    return _twin(unit).hash_encode(unit, tables, resolutions)


def spherical_harmonics(d: Tensor) -> Tensor:
    """See `reference.spherical_harmonics`."""
    return _twin(d).spherical_harmonics(d)


def hash_field(
    unit: Tensor, d: Tensor, tables: Tensor, resolutions: tuple[int, ...], networks: Networks
) -> tuple[Tensor, Tensor]:
    """See `reference.hash_field`."""
    return _twin(unit).hash_field(unit, d, tables, resolutions, networks)


def hash_density(unit: Tensor, net: DensityNet) -> Tensor:
    """See `reference.hash_density`."""
    return _twin(unit).hash_density(unit, net)


def weights(sigmas: Tensor, t_starts: Tensor, t_ends: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.weights`."""
    return _twin(sigmas).weights(sigmas, t_starts, t_ends, offsets)


def accumulate(w: Tensor, values: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.accumulate`."""
    return _twin(w).accumulate(w, values, offsets)


def distortion(w: Tensor, s_starts: Tensor, s_ends: Tensor, offsets: Tensor) -> Tensor:
    """See `reference.distortion`."""
    return _twin(w).distortion(w, s_starts, s_ends, offsets)


def march(
    rays: Rays3, space: Space, grid: Tensor, lattice: Lattice, fine: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.march`."""
    return _twin(grid).march(rays, space, grid, lattice, fine)


def march_visible(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    net: DensityNet,
    stop: float,
    fine: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.march_visible`."""
    return _twin(grid).march_visible(rays, space, grid, lattice, net, stop, fine)


def march_within(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    net: DensityNet,
    stop: float,
    fine: Tensor | None,
    within: Within,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See `reference.march_within`."""
    return _twin(grid).march_within(rays, space, grid, lattice, net, stop, fine, within)


def render(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    stop: float,
    fine: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """See `reference.render`."""
    return _twin(grid).render(rays, space, grid, lattice, field, stop, fine)


def next_samples(
    rays: Rays3, space: Space, grid: Tensor, lattice: Lattice, span: Span, most: int, fine: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """See `onward.next_samples`."""
    return _further(grid).next_samples(rays, space, grid, lattice, span, most, fine)


def render_until(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    stop: float,
    fine: Tensor | None,
    way: Way,
    lights: Lights,
) -> Tensor:
    """See `onward.render_until`."""
    return _further(grid).render_until(rays, space, grid, lattice, field, stop, fine, way, lights)


def shown_on(
    rays: Rays3,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    stop: float,
    fine: Tensor | None,
    way: Way,
    lights: Lights,
) -> Shown:
    """See `onward.shown_on`."""
    return _further(grid).shown_on(rays, space, grid, lattice, field, stop, fine, way, lights)


def blend(sums: Tensor, a: Shown, b: Shown) -> Tensor:
    """See `onward.blend`."""
    return _further(sums).blend(sums, a, b)


def relight(x: Tensor, rgb: Tensor, lights: Lights) -> Tensor:
    """See `onward.relight`."""
    return _further(x).relight(x, rgb, lights)


def adam(param: Tensor, grad: Tensor, first: Tensor, second: Tensor, rate: float, step: int) -> None:
    """See `reference.adam`."""
    _twin(param).adam(param, grad, first, second, rate, step)


def scatter_max(values: Tensor, cells: Tensor, into: Tensor) -> None:
    """See `reference.scatter_max`."""
    _twin(into).scatter_max(values, cells, into)


def train_step(
    batch: Batch,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    aim: Aim,
    into: list[Tensor],
    fine: Tensor | None = None,
) -> Stepped:
    """See `reference.train_step`."""
    return _twin(grid).train_step(batch, space, grid, lattice, field, aim, into, fine)


def woven_step(
    batch: Batch,
    fixed: Fixed,
    unwanted: Unwanted,
    space: Space,
    grid: Tensor,
    lattice: Lattice,
    field: tuple[Tensor, tuple[int, ...], Networks],
    aim: Aim,
    into: list[Tensor],
    fine: Tensor | None = None,
) -> Stepped:
    """See `reference.woven_step`."""
    return _twin(grid).woven_step(batch, fixed, unwanted, space, grid, lattice, field, aim, into, fine)


def observe(state: Tensor, now: int, decay: float, cells: Tensor, w: Tensor, sigmas: Tensor) -> None:
    """See `reference.observe`."""
    _twin(state).observe(state, now, decay, cells, w, sigmas)


def keep(state: Tensor, allowed: Tensor, opacity: float, weight: float, only_seen: bool) -> Tensor:
    """See `reference.keep`."""
    return _twin(state).keep(state, allowed, opacity, weight, only_seen)


def note(known: Tensor, cells: Tensor, parts: Tensor, opaque: Tensor) -> None:
    """See `reference.note`."""
    _twin(known).note(known, cells, parts, opaque)


def narrow(known: Tensor, grid: Tensor) -> Tensor:
    """See `reference.narrow`."""
    return _twin(known).narrow(known, grid)
