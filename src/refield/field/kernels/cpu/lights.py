"""Light on surfaces, on the CPU: colours times factors on lattices."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from torch import Tensor

from refield.field.kernels.cpu.encoding import array
from refield.field.kernels.cpu.simd import JIT, exp
from refield.field.kernels.onward import Lights

_ZERO, _ONE = np.float32(0), np.float32(1)


@njit(forceinline=True, **JIT)
def _along(x, low, high, nodes):  # type: ignore[no-untyped-def]
    """`scene.inside.cell_along` in single precision."""
    at = (x - low) / (high - low) * np.float32(nodes - 1)
    if not (at >= _ZERO and at <= np.float32(nodes - 1)):
        return -1, at
    node = min(int(at), nodes - 2)
    return node, at - np.float32(node)


@njit(**JIT)
def shine(x, y, z, lights, rgb):  # type: ignore[no-untyped-def]
    """`onward.relight` of one colour (3,), in place."""
    boxes, shapes, firsts, logs = lights
    for l in range(len(boxes)):
        i, u = _along(x, boxes[l, 0, 0], boxes[l, 1, 0], shapes[l, 0])
        j, v = _along(y, boxes[l, 0, 1], boxes[l, 1, 1], shapes[l, 1])
        k, w = _along(z, boxes[l, 0, 2], boxes[l, 1, 2], shapes[l, 2])
        if i < 0 or j < 0 or k < 0:
            continue
        red = green = blue = _ZERO
        for a in range(2):
            for b in range(2):
                side = (u if a else _ONE - u) * (v if b else _ONE - v)
                row = firsts[l] + ((i + a) * shapes[l, 1] + j + b) * shapes[l, 2] + k
                near, far = side * (_ONE - w), side * w
                red += near * logs[row, 0] + far * logs[row + 1, 0]
                green += near * logs[row, 1] + far * logs[row + 1, 1]
                blue += near * logs[row, 2] + far * logs[row + 1, 2]
        if red != 0 or green != 0 or blue != 0:
            rgb[0] = min(max(rgb[0] * exp(red), _ZERO), _ONE)
            rgb[1] = min(max(rgb[1] * exp(green), _ZERO), _ONE)
            rgb[2] = min(max(rgb[2] * exp(blue), _ZERO), _ONE)


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
