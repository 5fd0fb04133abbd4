"""The settings of the paper's route."""

from __future__ import annotations

from dataclasses import dataclass, field

from refield.estimate.hull import HullConfig
from refield.estimate.paper.detect import DetectConfig
from refield.estimate.paper.pose import PoseConfig
from refield.estimate.paper.refine import RefineConfig
from refield.estimate.paper.segment import SegmentConfig


@dataclass(frozen=True)
class PaperConfig:
    """Every step's settings; the defaults are the paper's where it gives any."""

    max_pixels: int = 800_000
    """larger photos are scaled down to this; the paper's have 756 x 1008"""
    survey: int = 6
    """old photos that the field's own errors are learnt from"""
    most_changed: float = 0.5
    """if more of the photos' pixels are in masks, they do not show this scene"""
    alike: float = 0.5
    """cosine similarity of pooled features below which masks before and after are of two objects"""
    detect: DetectConfig = field(default_factory=DetectConfig)
    """change masks"""  # §10.2.2
    pose: PoseConfig = field(default_factory=PoseConfig)
    """pose change from features"""  # §9.2
    refine: RefineConfig = field(default_factory=RefineConfig)
    """its refinement through the field"""  # §9.3
    segment: SegmentConfig = field(default_factory=SegmentConfig)
    """the object in 3-D and on the old photos"""  # §10.2.4
    hull: HullConfig = field(default_factory=lambda: HullConfig(longest=100))
    """the carving of newcomers, which the paper does not have"""
