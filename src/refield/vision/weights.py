"""Opens the segmenters, matchers and describers that need weights, from a local folder: config.json and *.safetensors.

Nothing is downloaded, unpickled or run from the folder. transformers is imported when a folder is opened, not before.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch

from refield.vision.describer import Describer, DinoDescriber
from refield.vision.lightglue import LightGlueMatcher
from refield.vision.matcher import Matcher
from refield.vision.sam import SAM, SAM2, SAM3, Family, SamSegmenter
from refield.vision.segmenter import Segmenter

Device = torch.device | str


class WeightsError(ValueError):
    """Weights that cannot be used: one line that says which folder, what is wrong and what to do."""

    def __init__(self, folder: Path, what: str, remedy: str) -> None:
        self.folder, self.what, self.remedy = folder, what, remedy
        super().__init__(f"{folder}: {what}; {remedy}")


CLASSES: dict[str, dict[str, str]] = {
    "sam": {"sam": "SamModel"},
    "sam-hq": {"sam_hq": "SamHQModel"},
    # The video models' files hold the image model's weights too, and are how SAM 2 and 2.1 are published.
    "sam2": {"sam2": "Sam2Model", "sam2_video": "Sam2Model"},
    "sam3": dict.fromkeys(("sam3_tracker", "sam3_tracker_video", "sam3_video"), "Sam3TrackerModel"),
    "lightglue": {"lightglue": "LightGlueForKeypointMatching"},
    "superglue": {"superglue": "SuperGlueForKeypointMatching"},
    "dinov2": {"dinov2": "Dinov2Model", "dinov2_with_registers": "Dinov2WithRegistersModel"},
}
"""by name: the ``model_type`` of config.json -> transformers' class"""


def open_model(folder: Path, classes: Mapping[str, str], device: Device = "cpu") -> Any:
    """A transformers model in evaluation mode, float32, from a folder with config.json and *.safetensors.

    Args:
        folder: as written by ``save_pretrained`` or ``hf download --local-dir``.
        classes: accepted ``model_type`` -> name of transformers' class.
        device: where the model goes.

    Raises:
        WeightsError: the folder, its files or transformers are missing; another kind of model; weights that do not
            fit config.json or are not finite.
    """
    folder = Path(folder)
    kind = _model_type(folder, classes)
    if not any(folder.glob("*.safetensors")):
        raise WeightsError(folder, "has no *.safetensors", "get the weights in that format; others are not read")
    return _load(folder, _transformers_class(folder, classes[kind]), kind).to(device).eval()


def _model_type(folder: Path, classes: Mapping[str, str]) -> str:
    """What kind of model the folder holds, read before anything is built."""
    if not folder.is_dir():
        raise WeightsError(folder, "is not a folder", "give the folder that holds config.json and *.safetensors")
    path = folder / "config.json"
    if not path.is_file():
        raise WeightsError(folder, "has no config.json", "get it from where the weights came from")
    try:
        text = path.read_text(encoding="utf-8")
        config = json.loads(text)
    except ValueError as error:
        raise WeightsError(folder, f"config.json is not JSON ({_line(error)})", "get the file again") from None
    config = config if isinstance(config, dict) else {}
    kind = str(config.get("model_type"))
    if kind not in classes:
        others = [name for name, accepted in CLASSES.items() if kind in accepted]
        remedy = f"use it as {others[0]!r}, or give" if others else "give"
        accepted = " or ".join(repr(c) for c in classes)
        raise WeightsError(folder, f"config.json has the model_type {kind!r}", f"{remedy} a folder with {accepted}")
    detector = config.get("keypoint_detector_config")
    finder = detector.get("model_type", "superpoint") if isinstance(detector, dict) else "superpoint"
    if finder != "superpoint":
        raise WeightsError(folder, f"finds keypoints with {finder!r}", "give weights that were trained on 'superpoint'")
    if '"auto_map"' in text:
        raise WeightsError(folder, "config.json asks for code from outside (auto_map)", "give a folder without it")
    return kind


def _transformers_class(folder: Path, name: str) -> Any:
    if importlib.util.find_spec("transformers") is None:
        raise WeightsError(folder, "needs transformers", "pip install 'refield[sam]'")
    try:
        return getattr(importlib.import_module("transformers"), name)
    except (ImportError, AttributeError, RuntimeError) as error:  # too old, or a broken torchvision beside it
        what = f"the transformers installed here has no working {name} ({_line(error)})"
        raise WeightsError(folder, what, "pip install -U 'refield[sam]'") from error


def _load(folder: Path, model_class: Any, kind: str) -> Any:
    again = "get config.json and *.safetensors again, together"
    try:
        with _quiet():
            more = {"config": _sam3_config(folder, model_class)} if kind == "sam3_video" else {}
            more |= {"local_files_only": True, "use_safetensors": True, "dtype": torch.float32}
            model, told = model_class.from_pretrained(folder, output_loading_info=True, **more)
    except Exception as error:  # whatever a library makes of a stranger's file
        raise WeightsError(folder, f"cannot be opened ({_line(error)})", again) from error
    missing = sorted(told["missing_keys"])
    if missing:
        raise WeightsError(folder, f"{len(missing)} weights are missing, such as {missing[0]}", again)
    damaged = [name for name, x in model.state_dict().items() if not torch.isfinite(x).all()]
    if damaged:
        raise WeightsError(folder, f"{len(damaged)} weights are not finite, such as {damaged[0]}", again)
    return model


def _sam3_config(folder: Path, model_class: Any) -> Any:
    """The tracker's part of the config of SAM 3 as published: detector and tracker share one backbone and one file."""
    whole = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    parts = {name: whole["tracker_config"].get(name) for name in ("prompt_encoder_config", "mask_decoder_config")}
    return model_class.config_class(vision_config=whole["detector_config"].get("vision_config"), **parts)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without transformers' progress bar and advice: what matters is raised as `WeightsError`."""
    logging = importlib.import_module("transformers").utils.logging
    level, bar = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity(logging.CRITICAL)
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bar:
            logging.enable_progress_bar()


def _line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:160]


def _segmenter(name: str, family: Family, folder: Path, device: Device = "cpu") -> Segmenter:
    return SamSegmenter(open_model(folder, CLASSES[name], device), family, device)


def _matcher(name: str, folder: Path, device: Device = "cpu") -> Matcher:
    return LightGlueMatcher(open_model(folder, CLASSES[name], device), device)


def _describer(name: str, folder: Path, device: Device = "cpu") -> Describer:
    return DinoDescriber(open_model(folder, CLASSES[name], device), device)


SEGMENTERS: dict[str, Callable[[Path, Device], Segmenter]] = {
    name: partial(_segmenter, name, family)
    for name, family in {"sam": SAM, "sam-hq": SAM, "sam2": SAM2, "sam3": SAM3}.items()
}
"""by name: (folder, device) -> a segmenter; raises `WeightsError`"""

MATCHERS: dict[str, Callable[[Path, Device], Matcher]] = {
    name: partial(_matcher, name) for name in ("lightglue", "superglue")
}
"""by name: (folder, device) -> a matcher; raises `WeightsError`"""

DESCRIBERS: dict[str, Callable[[Path, Device], Describer]] = {"dinov2": partial(_describer, "dinov2")}
"""by name: (folder, device) -> a describer; raises `WeightsError`"""
