"""The numbers of the paper's update: the paper's own, and nerfstudio's where the paper keeps its defaults."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class PaperUpdateConfig:
    """The paper's update."""

    dilation: float = 2.0
    """The helper answers in each object's grid, its box this many times as large. The paper says 2 to 3; larger regions
    take longer to learn"""  # §10.1.3
    shadow: float = 0.01
    """old photos: pixels this near to where an object was seen, in image widths, are masked with it"""  # §10.1.3
    far: float = 0.15
    """old photos: pixels further from there than this, in image widths, are masked"""  # §10.1.3
    look: int = 32
    """numbers that stand for a photo's look: the helper's appearance embedding"""  # §10.1
    steps: int = 1500
    """of gradient descent; the paper: 500 to 1500"""  # §11.3.2
    max_seconds: float | None = None
    """stop in time"""
    rays: int = 4096
    """a step, drawn from all pixels of old and new photos that are not masked"""
    rate: float = 1e-2
    """Adam's learning rate at the first step, of the helper and of the proposal networks"""
    final_rate: float = 1e-4
    """and after ``decay_steps``, exponentially"""
    decay_steps: int = 200_000
    """longer than the update: the rate hardly falls"""
    interlevel: float = 1.0
    """weight of the proposals' loss"""
    distortion: float = 2e-3
    """weight of the distortion loss"""
    gradient_unit: float = 1.0
    """gradient scaling reaches 1 at this many core radii of the old field from the camera"""  # §10.1
    proposal_every: int = 5
    """steps between the proposals' own steps, at the end"""
    proposal_warmup: int = 5000
    """steps over which that interval grows from 1"""
    check_every: int = 25
    """steps between words of how far it is"""
    seed: int = 0


def reduced(config: PaperUpdateConfig) -> PaperUpdateConfig:
    """The same update on a schedule for a CPU: a quarter of the rays in each step, and a learning rate that falls
    within the steps. Regions, masks and losses stay; the helper's shape is the old field's in either."""
    return replace(config, rays=1024, decay_steps=config.steps)
