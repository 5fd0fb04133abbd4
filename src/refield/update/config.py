"""Choices of the update (§4.1, §10.1)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from refield.update.paper.config import PaperUpdateConfig


@dataclass(frozen=True)
class UpdateConfig:
    """How the helper is trained and shown."""

    dilation: float = 1.5
    """The helper trains and is shown in each object's grid, its box this many times as large. The paper says 2 to 3;
    but with the carved object known to be empty and the light set right the old field knows the surroundings better."""
    ground: float = 2.0
    """The ground that objects stood on gets the texture that the new photos show, within each object's grid at its old
    and its new place, its box this many times as large (the paper: 2 to 3). When the object moves on, what lies within
    `composite.DILATION` times its box is forgotten."""
    shadow: float = 0.01
    """Old photos: pixels this near to an object's mask, in image widths, may hold its shadow."""  # §10.1.3
    far: float = 0.15
    """Old photos: pixels further away than this, in image widths, do not teach."""  # §10.1.3
    relight: bool = True
    """Fit how the light on unchanged surfaces changed."""
    steps: int = 200
    """of gradient descent"""
    max_seconds: float = 20.0
    """for all of the steps; the learning rate follows whichever of steps and seconds is further on"""
    samples: int = 8192
    """of the helper in a step"""
    sparse_share: float = 0.5
    """of each batch's rays drawn from the new photos"""
    rate: float = 2e-2
    """Adam's learning rate, held for the first half, then brought down to a thirtieth"""
    distortion: float = 1e-2
    """weight of the distortion loss"""
    gradient_unit: float = 1.0
    """gradient scaling reaches 1 at this many core radii of the old field from the camera"""  # §10.1
    emptiness: float = 5e-2
    """weight of the colour that comes from where nothing can be: deep inside what left, where nothing was before and,
    half as much, beneath the ground that it stood on and above that in its rim and right beside it"""
    held_out: int = 20
    """every so-many-th pixel that could teach is kept to judge by"""
    check_every: int = 25
    """steps between looks at the held-out pixels"""
    patience: int = 3
    """looks without ``least_gain`` after which training stops"""
    least_gain: float = 0.03
    """dB"""
    seed: int = 0
    route: Literal["refield", "paper", "paper-reduced"] = "refield"
    """refield's own update, which the settings above are of, or the paper's as it gives it, of a field of NeRFacto's
    shape; paper-reduced: in smaller steps, for a CPU, whatever ``paper`` says of these"""
    paper: PaperUpdateConfig = field(default_factory=PaperUpdateConfig)
    """the paper's update"""
