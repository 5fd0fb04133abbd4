"""Light on surfaces, on the CPU: colours times factors on lattices."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange
from torch import Tensor

from refield.field.kernels.cpu.encoding import array
from refield.field.kernels.cpu.simd import JIT
from refield.field.kernels.onward import Lights
from refield.scene.inside import cell_along


@njit(**JIT)
def shine(x, y, z, lights, rgb):  # type: ignore[no-untyped-def]
    """`onward.relight` of one colour (3,), in place."""
    boxes, shapes, firsts, logs = lights
    for l in range(len(boxes)):
        i, u = cell_along(x, boxes[l, 0, 0], boxes[l, 1, 0], shapes[l, 0])
        j, v = cell_along(y, boxes[l, 0, 1], boxes[l, 1, 1], shapes[l, 1])
        k, w = cell_along(z, boxes[l, 0, 2], boxes[l, 1, 2], shapes[l, 2])
        if i < 0 or j < 0 or k < 0:
            continue
        red = green = blue = np.float32(0)
        for corner in range(8):
            a, b, c = corner >> 2 & 1, corner >> 1 & 1, corner & 1
            weight = np.float32((u if a else 1 - u) * (v if b else 1 - v) * (w if c else 1 - w))
            row = firsts[l] + ((i + a) * shapes[l, 1] + j + b) * shapes[l, 2] + k + c
            red, green, blue = red + weight * logs[row, 0], green + weight * logs[row, 1], blue + weight * logs[row, 2]
        if red != 0 or green != 0 or blue != 0:
            rgb[0] = min(max(rgb[0] * np.float32(math.exp(red)), np.float32(0)), np.float32(1))
            rgb[1] = min(max(rgb[1] * np.float32(math.exp(green)), np.float32(0)), np.float32(1))
            rgb[2] = min(max(rgb[2] * np.float32(math.exp(blue)), np.float32(0)), np.float32(1))


@njit(parallel=True, **JIT)
def _relight(x, lights, rgb):  # type: ignore[no-untyped-def]
    for s in prange(len(x)):
        shine(x[s, 0], x[s, 1], x[s, 2], lights, rgb[s])


def arrays_of(lights: Lights) -> tuple[np.ndarray, ...]:
    return tuple(array(t) for t in lights)


def relight(x: Tensor, rgb: Tensor, lights: Lights) -> Tensor:
    """See `onward.relight`."""
    out = rgb.detach().clone().contiguous()
    _relight(array(x.float()), arrays_of(lights), out.numpy())
    return out
