"""The hot loops for a GPU, by Triton: the same functions as `reference`, value for value and gradient for gradient.

Nothing here asks the device for a number, except marching and a training step without a capacity, so that everything
else can be called while a CUDA graph is captured. Launch grids follow from shapes alone. Sums are float32.

Letters, here and in the files beside: B samples a block; P behind a letter is its padding to a power of two.
"""

try:
    import triton  # noqa: F401
except ImportError as error:
    raise ImportError(
        "the GPU kernels need triton, which torch's CUDA builds bring along: pip install 'triton>=3.6'"
    ) from error

from refield.field.kernels.gpu.encoding import hash_encode
from refield.field.kernels.gpu.marching import march, march_visible
from refield.field.kernels.gpu.networks import hash_density, hash_field
from refield.field.kernels.gpu.optimiser import adam, adam_scale, descend, observe, scatter_max
from refield.field.kernels.gpu.rays import accumulate, contract, distortion, ray_ids, spherical_harmonics, weights
from refield.field.kernels.gpu.rendering import render
from refield.field.kernels.gpu.step import train_step
from refield.field.kernels.onward import (  # torch's own kernels do for these, too
    blend,
    next_samples,
    relight,
    render_until,
    shown_on,
)
from refield.field.kernels.reference import (  # torch's own kernels do for those; nobody trains a helper on a GPU yet
    keep,
    march_within,
    narrow,
    note,
    woven_step,
)

__all__ = [
    "accumulate",
    "adam",
    "adam_scale",
    "blend",
    "contract",
    "descend",
    "distortion",
    "hash_density",
    "hash_encode",
    "hash_field",
    "keep",
    "march",
    "march_visible",
    "march_within",
    "narrow",
    "next_samples",
    "note",
    "observe",
    "ray_ids",
    "relight",
    "render",
    "render_until",
    "scatter_max",
    "shown_on",
    "spherical_harmonics",
    "train_step",
    "weights",
    "woven_step",
]
