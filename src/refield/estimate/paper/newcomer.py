"""Where something arrived, carved from its move-in masks alone: the old field knows nothing of it.

The paper has only objects that moved. This is its projection check, with the new photos' masks in place of the old.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from refield.estimate.detect import Changed
from refield.estimate.hull import HullConfig, carve, find_regions
from refield.estimate.lattice import Body, components
from refield.estimate.look import View
from refield.estimate.paper.associate import Thing
from refield.scene.change import OccupancyGrid


def newcomer_grid(came: Thing, old: Sequence[View], config: HullConfig) -> OccupancyGrid | None:
    """The grid of what lies in a newcomer's masks in every view that shows it and was empty; None if nothing does.

    Args:
        old: renderings of the old field, which tell what was empty.
    """
    changed = [
        Changed(s.pair.view, s.pair.unlike, np.zeros_like(s.pair.unlike), s.mask, *np.zeros((2, *s.mask.shape), bool))
        for s in came.sightings
    ]
    views, seen = [*old, *(c.view for c in changed)], [(c.view, c.mask) for c in changed]
    parts = []
    for region in find_regions(changed, config, 0.0):
        carved = carve(region, seen, views, (), config)
        parts += [Body(region, voxels) for voxels in components(carved.hull & ~carved.solid, config.smallest)]
    body = max(parts, key=lambda b: b.volume, default=None)
    return None if body is None else body.lattice.grid(body.voxels.astype(np.float32))
