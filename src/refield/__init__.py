"""refield keeps a radiance field true to a scene whose objects move.

    capture = refield.load_capture(Path("before"))
    field = refield.fit_field(capture)
    photos = refield.load_new_photos(Path("after"), capture)
    change = refield.estimate_change(capture, field, photos)
    updated = refield.update_field(capture, field, change)

Photos without poses: `capture_from_photos` in place of `load_capture`, `localize_photos` of `load_new_photos`.

This is the table of contents; a name is imported when it is first used. Metrics are in `refield.evaluate`,
the report page in `refield.report`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from refield.estimate.localize import known_by, localize_photos
    from refield.estimate.recipe import estimate_change
    from refield.field.fit import fit_field
    from refield.field.radiance import Field, HashField
    from refield.field.render import render_frame
    from refield.photos.capture import capture_from_photos
    from refield.scene.capture import Capture, Frame
    from refield.scene.change import ObjectChange, OccupancyGrid, SceneChange
    from refield.scene.errors import InputError
    from refield.scene.images import write_image
    from refield.scene.load import load_capture, load_new_photos
    from refield.update.composite import UpdatedField
    from refield.update.train import update_field
    from refield.workspace import Workspace

__version__ = "0.1.0"

__all__ = [
    "Capture",
    "Field",
    "Frame",
    "HashField",
    "InputError",
    "ObjectChange",
    "OccupancyGrid",
    "SceneChange",
    "UpdatedField",
    "Workspace",
    "capture_from_photos",
    "estimate_change",
    "fit_field",
    "known_by",
    "load_capture",
    "load_new_photos",
    "localize_photos",
    "render_frame",
    "update_field",
    "write_image",
]

_HOME = {
    "scene.capture": ("Capture", "Frame"),
    "scene.change": ("ObjectChange", "OccupancyGrid", "SceneChange"),
    "scene.errors": ("InputError",),
    "scene.images": ("write_image",),
    "scene.load": ("load_capture", "load_new_photos"),
    "field.fit": ("fit_field",),
    "field.radiance": ("Field", "HashField"),
    "field.render": ("render_frame",),
    "estimate.localize": ("known_by", "localize_photos"),
    "estimate.recipe": ("estimate_change",),
    "photos.capture": ("capture_from_photos",),
    "update.composite": ("UpdatedField",),
    "update.train": ("update_field",),
    "workspace": ("Workspace",),
}
_MODULE_OF = {name: f"refield.{module}" for module, names in _HOME.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'refield' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
