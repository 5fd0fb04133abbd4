"""A run's folder: its config.yml as plain data, where its checkpoint and its photos are.

config.yml is YAML with tags that name Python classes. They are read as data: nothing is imported, nothing is called.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from refield.scene.errors import InputError
from refield.scene.transforms_json import NAME

CONFIG, TRANSFORM = "config.yml", "dataparser_transforms.json"
TAG = "!"
"""the key under which a mapping that stood for an object has its class"""
MODELS = ("NerfactoModel", "DepthNerfactoModel")
"""what is read: the field of both is the same"""
PARSER = "NerfstudioDataParserConfig"
"""the only data parser of which it is known what it did to the poses: that of a transforms.json"""
_PYTHON = "tag:yaml.org,2002:python/"
_MAX_BYTES = 1 << 22


@dataclass(frozen=True)
class Run:
    """What config.yml says."""

    folder: Path
    """in which it lies"""
    model: dict[str, Any]
    """the model's settings"""
    parser: dict[str, Any]
    """the data parser's settings"""
    named: tuple[Path, ...]
    """where the config says that the photos are, the most likely first"""

    @property
    def config(self) -> Path:
        """The file itself, for messages."""
        return self.folder / CONFIG

    def checkpoint(self, step: int | None) -> Path:
        """The checkpoint of a step, or the last one.

        Raises:
            InputError: there is none.
        """
        folder = self.folder / "nerfstudio_models"
        found = {int(p.stem[5:]): p for p in folder.glob("step-*.ckpt") if p.stem[5:].isdigit()}
        if not found:
            raise InputError(
                folder, "holds no checkpoint step-….ckpt", "give the folder of a run that has been trained"
            )
        if step is not None and step not in found:
            steps = ", ".join(str(s) for s in sorted(found))
            raise InputError(folder, f"holds no checkpoint of step {step}", f"give one of {steps}")
        return found[max(found) if step is None else step]

    def data(self, given: Path | None) -> Path:
        """The file with the photos' poses: in ``given``, else where the run was trained from.

        Raises:
            InputError: it is of a kind that is not read, or not there.
        """
        kind = self.parser.get(TAG, "").rpartition(".")[2]
        if kind != PARSER:
            what = f"its photos were read by {kind or 'an unknown data parser'}, not from a transforms.json"
            raise InputError(self.config, what, "train on a transforms.json (ns-process-data makes one)")
        places = (given,) if given is not None else self._places()
        for place in places:
            path = place if place.suffix == ".json" else place / NAME
            if path.is_file():
                return path
        if given is not None:
            raise InputError(given, f"holds no {NAME}", "give the folder that the run was trained on")
        named = str(self.named[0]) if self.named else "nowhere"
        what = f"its photos are not found ({named}, from here or from any folder above the run)"
        raise InputError(self.config, what, "say where they are with --data")

    def _places(self) -> tuple[Path, ...]:
        """Relative paths are those of the folder in which the run was started: here, or one that holds the run."""
        above = (Path(), *self.folder.resolve().parents)
        return tuple(p if p.is_absolute() else root / p for p in self.named for root in above)


def read_run(path: Path) -> Run:
    """The run in a folder, or of a config.yml.

    Raises:
        InputError: there is no config.yml, it cannot be read, or it is another method's.
    """
    config = path if path.is_file() else path / CONFIG
    if not config.is_file():
        below = sorted(path.glob(f"**/{CONFIG}"))[:3] if path.is_dir() else []
        hint = f"give one of its runs, such as {below[0].parent}" if below else "give outputs/NAME/nerfacto/DATE"
        raise InputError(path, f"holds no {CONFIG}" if path.exists() else "there is no such folder", hint)
    told = read_config(config)
    pipeline = _dict(told.get("pipeline"))
    model, manager = _dict(pipeline.get("model")), _dict(pipeline.get("datamanager"))
    kind = _dict(model.get("_target")).get(TAG, "").rpartition(".")[2]
    if kind not in MODELS:
        method = told.get("method_name") or "an unknown method"
        what = f"is a run of {method} ({kind or 'no model is named'}); only nerfacto's field can be taken over"
        raise InputError(config, what, "train it with ns-train nerfacto, or fit a field to its photos: refield train")
    parser = _dict(manager.get("dataparser"))
    named = [_path(p) for p in (manager.get("data"), parser.get("data"), told.get("data"))]
    return Run(config.parent, model, parser, tuple(dict.fromkeys(p for p in named if p is not None)))


def read_config(path: Path) -> dict[str, Any]:
    """A nerfstudio config as dictionaries, lists and scalars. What stood for an object is a dictionary with its class
    under `TAG`; what was a call also has its arguments, under "args".

    Raises:
        InputError: it cannot be read, or is no such file; or PyYAML is not installed.
    """
    yaml = _yaml()
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise InputError(path, "is far larger than any config.yml", "check that it is one")
        told = yaml.load(path.read_text(encoding="utf-8"), Loader=_loader(yaml))
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "check the path and its permissions") from None
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError, TypeError) as error:
        what = f"is not the YAML of a config ({' '.join(str(error).split())})"
        raise InputError(path, what, "restore the file that nerfstudio wrote") from None
    if not isinstance(told, dict):
        raise InputError(path, "does not describe a run", "restore the file that nerfstudio wrote")
    return told


def _yaml() -> Any:
    try:
        import yaml
    except ImportError:
        what = "reading nerfstudio's config.yml needs PyYAML"
        raise InputError("PyYAML", what, "pip install 'refield[nerfstudio]'") from None
    return yaml


def _loader(yaml: Any) -> Any:
    """A loader that makes plain data of everything that is tagged."""

    class Plain(yaml.SafeLoader):
        pass

    Plain.add_multi_constructor(_PYTHON, _plain(yaml))
    return Plain


def _plain(yaml: Any) -> Callable[[Any, str, Any], Any]:
    def plain(loader: Any, tag: str, node: Any) -> Any:
        kind, _, name = tag.partition(":")
        if isinstance(node, yaml.MappingNode):
            return {**loader.construct_mapping(node, deep=True), TAG: name or kind}
        if isinstance(node, yaml.SequenceNode):
            parts = loader.construct_sequence(node, deep=True)
            return {"args": parts, TAG: name} if name else parts
        return {TAG: name} if name else loader.construct_scalar(node)

    return plain


def _path(told: Any) -> Path | None:
    """A path as a config has it: text, or the parts of a pathlib object; None where nothing is said."""
    parts = _dict(told).get("args") if isinstance(told, dict) else [told]
    if not isinstance(parts, list) or not parts or not all(isinstance(p, str) and p for p in parts):
        return None
    return Path(*parts)


def _dict(told: Any) -> dict[str, Any]:
    return told if isinstance(told, dict) else {}
