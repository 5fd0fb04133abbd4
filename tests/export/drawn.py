"""Splats drawn as 3D Gaussian Splatting does, from the published formulas: nothing of the export's is used."""

import math

import numpy as np
from numba import njit


def draw(splats, camera, cam_from_world):
    """A picture (H, W, 3) of ``splats`` (means, scales, quaternions wxyz, opacities, rgb) by a pinhole camera."""
    means, scales, q, opacities, rgb = (np.asarray(v, np.float64) for v in splats)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    turn = np.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        -1,
    ).reshape(-1, 3, 3)
    view = cam_from_world[:3, :3]
    local = means @ view.T + cam_from_world[:3, 3]
    depth = local[:, 2]
    half = view @ turn * scales[:, None, :]
    slope = np.zeros((len(means), 2, 3))
    safe = np.where(depth > 0.05, depth, 1.0)
    # as the method's own code has it: what lies far beside the picture is projected as if it were at 1.3 of its border
    for row, focal, size in ((0, camera.fx, camera.width), (1, camera.fy, camera.height)):
        aside = np.clip(local[:, row] / safe, -0.65 * size / focal, 0.65 * size / focal)
        slope[:, row, row], slope[:, row, 2] = focal / safe, -focal * aside / safe
    flat = slope @ half
    spread = flat @ flat.transpose(0, 2, 1) + 0.3 * np.eye(2)
    at = np.stack([camera.fx * local[:, 0] / safe + camera.cx, camera.fy * local[:, 1] / safe + camera.cy], -1)
    order = np.argsort(depth)
    order = order[depth[order] > 0.05]
    picture, left = np.zeros((camera.height, camera.width, 3)), np.ones((camera.height, camera.width))
    _blend(order, at, spread, opacities, rgb, picture, left)
    return picture


@njit(cache=True)
def _blend(order, at, spread, opacities, rgb, picture, left):
    height, width = left.shape
    for g in order:
        a, b, c = spread[g, 0, 0], spread[g, 0, 1], spread[g, 1, 1]
        det = a * c - b * b
        reach = 3 * math.sqrt((a + c) / 2 + math.sqrt(max(((a - c) / 2) ** 2 + b * b, 0.0)))
        if det <= 0 or abs(at[g, 0]) > 1e6 or abs(at[g, 1]) > 1e6:
            continue
        for row in range(max(0, int(at[g, 1] - reach)), min(height, int(at[g, 1] + reach) + 1)):
            for column in range(max(0, int(at[g, 0] - reach)), min(width, int(at[g, 0] + reach) + 1)):
                dx, dy = column + 0.5 - at[g, 0], row + 0.5 - at[g, 1]
                alpha = opacities[g] * math.exp(-0.5 * (c * dx * dx - 2 * b * dx * dy + a * dy * dy) / det)
                if alpha < 1 / 255:
                    continue
                alpha = min(alpha, 0.99)
                picture[row, column] += left[row, column] * alpha * rgb[g]
                left[row, column] *= 1 - alpha
