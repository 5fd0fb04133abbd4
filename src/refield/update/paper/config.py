"""The numbers of the paper's update: the paper's own, and nerfstudio's where the paper keeps its defaults."""

from __future__ import annotations

from dataclasses import dataclass, replace

from refield.field.fit_nerfacto import Schedule


@dataclass(frozen=True)
class PaperUpdateConfig(Schedule):
    """The paper's update, by nerfstudio's schedule."""

    steps: int = 1500
    """of gradient descent; the paper: 500 to 1500"""  # §11.3.2
    check_every: int = 25
    """steps between words of how far it is"""
    dilation: float = 2.0
    """The helper answers in each object's grid, its box this many times as large. The paper says 2 to 3; larger regions
    take longer to learn"""  # §10.1.3
    shadow: float = 0.01
    """old photos: pixels this near to where an object was seen, in image widths, are masked with it"""  # §10.1.3
    far: float = 0.15
    """old photos: pixels further from there than this, in image widths, are masked"""  # §10.1.3
    look: int = 32
    """numbers that stand for a photo's look: the helper's appearance embedding"""  # §10.1


def reduced(config: PaperUpdateConfig) -> PaperUpdateConfig:
    """The same update on a schedule for a CPU: a quarter of the rays in each step, and a learning rate that falls
    within the steps. Regions, masks and losses stay; the helper's shape is the old field's in either."""
    return replace(config, rays=1024, decay_steps=config.steps)
