"""The whole chain on small worlds and photographs: path-traced, fitted, estimated, updated, evaluated.

Nothing is faked: a fault anywhere between the photos and the picture shows here, where a unit test with a change made
up for it would not notice.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest

pytestmark = pytest.mark.chain

LOST = 0.1
"""dB that untouched pixels may lose"""


@dataclass(frozen=True)
class Floors:
    """What a scene has to reach."""

    true: tuple[str, ...]
    """the kinds that changed"""
    psnr_in: float | None = None
    """dB; None where nothing arrived"""
    psnr_out: float | None = None
    """None where nothing left"""
    untouched: float = 0.0
    """dB"""
    off: float | None = None
    """at most, of each moved object, % of the distance from the cameras"""
    degrees: float | None = None
    """at most"""


# FLOORS
WORLDS: dict[str, Floors] = {}


@pytest.mark.parametrize("name", WORLDS)
def test_world(name: str, world) -> None:
    check(world(name), WORLDS[name])


def check(row: dict[str, Any], floors: Floors) -> None:
    """Every command ended well, what changed was understood, and the pictures are as good as they were measured."""
    assert row["failed"] is None, row["failed"]
    assert row["true"] == sorted(floors.true)
    assert row["told"] == row["true"], row["objects"]
    assert row["right"], {k: row[k] for k in ("objects", "false", "pieces", "missed", "not understood")}
    moved = [o for o in row["objects"] if o["true"] == "moved"]
    assert all(o["off, % of distance"] <= floors.off and o["off, °"] <= floors.degrees for o in moved), moved
    for name in ("psnr_in", "psnr_out"):
        least = getattr(floors, name)
        assert least is None or row[name] >= least, {k: v for k, v in row.items() if k.startswith("psnr")}
    assert row["psnr_untouched"] >= max(floors.untouched, row["psnr_untouched before"] - LOST)
