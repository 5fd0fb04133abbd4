"""What the estimate borrows from 2-D vision: a segmenter and a matcher, with or without weights."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from refield.field.fit import need_device
from refield.scene.errors import InputError
from refield.vision.describer import Describer
from refield.vision.matcher import Matcher, SiftMatcher
from refield.vision.segmenter import GrabCutSegmenter, Segmenter


@dataclass(frozen=True)
class Models:
    """What is borrowed from 2-D vision. The paper: SAM, and SuperPoint with LightGlue."""

    segmenter: Segmenter = field(default_factory=GrabCutSegmenter)
    """image features, and masks from boxes with a confidence"""
    matcher: Matcher = field(default_factory=SiftMatcher)
    """corresponding points of two pictures"""
    describer: Describer | None = None
    """which old photos look like a new one; None: VLAD of the capture's own features. The paper: NetVLAD"""


@dataclass(frozen=True)
class ModelConfig:
    """Which of them; those with weights read them from a local folder (docs/weights.md)."""

    segmenter: Literal["grabcut", "sam", "sam-hq", "sam2", "sam3"] = field(default="grabcut", metadata={"usual": True})
    """cuts things out of pictures. All but grabcut need weights"""
    segmenter_weights: Path | None = field(default=None, metadata={"usual": True})
    """folder with config.json and *.safetensors"""
    matcher: Literal["sift", "lightglue", "superglue"] = field(default="sift", metadata={"usual": True})
    """finds corresponding points. All but sift need weights"""
    matcher_weights: Path | None = field(default=None, metadata={"usual": True})
    """folder with config.json and *.safetensors"""
    describer: Literal["vlad", "dinov2"] = "vlad"
    """finds old photos that look like a new one without a pose; dinov2 needs weights"""
    describer_weights: Path | None = None
    """folder with config.json and *.safetensors"""
    device: Literal["cpu", "cuda"] = "cpu"
    """where models with weights run"""

    def open(self) -> Models:
        """Load what was chosen.

        Raises:
            InputError: weights are not given, or cannot be used.
        """
        if (self.segmenter, self.matcher, self.describer) == ("grabcut", "sift", "vlad"):
            return Models()
        from refield.vision.weights import DESCRIBERS, MATCHERS, SEGMENTERS, WeightsError

        need_device(self.device)

        def folder(kind: str, name: str, given: Path | None) -> Path:
            if given is None:
                what = f"{name} needs weights, and none are given"
                raise InputError(f"--estimate.models.{kind}", what, f"add --estimate.models.{kind}-weights FOLDER")
            return given

        segmenter: Segmenter = GrabCutSegmenter()
        matcher: Matcher = SiftMatcher()
        describer: Describer | None = None
        try:
            if self.segmenter != "grabcut":
                where = folder("segmenter", self.segmenter, self.segmenter_weights)
                segmenter = SEGMENTERS[self.segmenter](where, self.device)
            if self.matcher != "sift":
                where = folder("matcher", self.matcher, self.matcher_weights)
                matcher = MATCHERS[self.matcher](where, self.device)
            if self.describer != "vlad":
                where = folder("describer", self.describer, self.describer_weights)
                describer = DESCRIBERS[self.describer](where, self.device)
        except WeightsError as error:
            raise InputError(error.folder, error.what, error.remedy) from error
        return Models(segmenter, matcher, describer)
