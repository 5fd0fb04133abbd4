"""Choices of the update (§4.1, §10.1): its stages, in the order in which they run, each with its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from refield.update.cut import CutConfig
from refield.update.fit_helper import HelperConfig
from refield.update.frozen import FreezeConfig
from refield.update.ground import GroundConfig
from refield.update.paper.config import PaperUpdateConfig
from refield.update.relight import RelightConfig
from refield.update.spared import ShowConfig
from refield.update.supervision import SuperviseConfig


@dataclass(frozen=True)
class UpdateConfig:
    """The update."""

    cut: CutConfig = field(default_factory=CutConfig)
    """what moved is moved, what left is cut out"""
    relight: RelightConfig = field(default_factory=RelightConfig)
    """light that changed"""
    supervise: SuperviseConfig = field(default_factory=SuperviseConfig)
    """which pixels teach"""
    ground: GroundConfig = field(default_factory=GroundConfig)
    """what objects stood on"""
    freeze: FreezeConfig = field(default_factory=FreezeConfig)
    """what of the old field stays"""
    fit: HelperConfig = field(default_factory=HelperConfig)
    """the helper's training"""
    show: ShowConfig = field(default_factory=ShowConfig)
    """what is kept"""
    seed: int = 0
    """of all that is drawn at random"""
    route: Literal["refield", "paper", "paper-reduced"] = "refield"
    """refield's own update, which the settings above are of, or the paper's as it gives it, of a field of NeRFacto's
    shape; paper-reduced: in smaller steps, for a CPU, whatever ``paper`` says of these"""
    paper: PaperUpdateConfig = field(default_factory=PaperUpdateConfig)
    """the paper's update"""
