"""The hot loops for the CPU, by numba: the same functions as `reference`, value for value and gradient for gradient.

Loops over samples or rays run in parallel; scatters run in parallel over levels, so nothing is atomic, and partial
sums are over a fixed number of groups: results are the same, bit for bit, for every thread count.
"""

from refield.field.kernels.cpu.cells import narrow, note
from refield.field.kernels.cpu.encoding import hash_encode
from refield.field.kernels.cpu.lights import relight
from refield.field.kernels.cpu.marching import hash_density, march, march_visible, march_within
from refield.field.kernels.cpu.networks import hash_field
from refield.field.kernels.cpu.onward import blend, next_samples, render_until, shown_on
from refield.field.kernels.cpu.optimiser import adam, keep, observe, scatter_max
from refield.field.kernels.cpu.rays import accumulate, contract, distortion, spherical_harmonics, weights
from refield.field.kernels.cpu.rendering import render
from refield.field.kernels.cpu.step import train_step
from refield.field.kernels.cpu.woven import woven_step

__all__ = [
    "accumulate",
    "adam",
    "blend",
    "contract",
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
