"""refield keeps a radiance field true to a scene whose objects move.

A workspace, made by the command line or from Python:

    scene = refield.open("work")            its visits, capture(), field(), change(), undo()
    scene.update("after")                   a few new photos: what changed, kept as a visit
    scene.render(scene.capture().frames[0]).rgb

Step by step:

    capture = refield.load_capture("before")
    field = refield.fit_field(capture)
    photos = refield.load_new_photos("after", capture)
    change = refield.estimate_change(capture, field, photos)
    updated = refield.update_field(capture, field, change)
    refield.write_image("now.png", refield.render_frame(updated, photos[0]).rgb)

Functions
    open                  a workspace as a Scene
    load_capture          photos with poses: a transforms.json or a COLMAP model
    capture_from_photos   photos without: poses are found
    fit_field             a capture -> its field
    load_new_photos       new photos with poses in the capture's world
    localize_photos       new photos without, placed in what known_by tells of a capture
    estimate_change       what moved, left or arrived
    update_field          a field and a change -> the field as things are now
    render_frame          what a field shows from where a photo was taken
    write_image           a picture as a PNG

Types
    Scene, Workspace      a workspace as an object, and as a folder
    Capture, Frame        photos with their poses
    Field                 what is asked of a field, also of your own
    HashField             the one that fit_field makes
    UpdatedField          the one that update_field makes: a field again
    SceneChange, ObjectChange, OccupancyGrid    what changed: plain data
    InputError            input that cannot be used: where, what, and what to do

help(refield.fit_field) and the like tell more. Metrics are in refield.evaluate, the report page in refield.report;
files and axes are described in docs/conventions.md.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

# There is no __all__: with one, help(refield) would print every class in full. Type checkers take "name as name" for
# public.
if TYPE_CHECKING:
    from refield.estimate.localize import known_by as known_by
    from refield.estimate.localize import localize_photos as localize_photos
    from refield.estimate.recipe import estimate_change as estimate_change
    from refield.field.fit import fit_field as fit_field
    from refield.field.radiance import Field as Field
    from refield.field.radiance import HashField as HashField
    from refield.field.render import render_frame as render_frame
    from refield.photos.capture import capture_from_photos as capture_from_photos
    from refield.scene.capture import Capture as Capture
    from refield.scene.capture import Frame as Frame
    from refield.scene.change import ObjectChange as ObjectChange
    from refield.scene.change import OccupancyGrid as OccupancyGrid
    from refield.scene.change import SceneChange as SceneChange
    from refield.scene.errors import InputError as InputError
    from refield.scene.images import write_image as write_image
    from refield.scene.load import load_capture as load_capture
    from refield.scene.load import load_new_photos as load_new_photos
    from refield.update.composite import UpdatedField as UpdatedField
    from refield.update.train import update_field as update_field
    from refield.visits.opened import Scene as Scene
    from refield.visits.opened import open as open
    from refield.workspace import Workspace as Workspace

__version__ = "0.1.0"

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
    "visits.opened": ("Scene", "open"),
    "workspace": ("Workspace",),
}
_MODULE_OF = {name: f"refield.{module}" for module, names in _HOME.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'refield' has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted([*_MODULE_OF, "__doc__", "__version__"])


def _wait_calmly() -> None:
    """Have threads that wait for the others sleep soon, so that what runs beside them is not held up, nor they by it.

    GNU's OpenMP, of which torch and numba each load one on Linux, reads this when it is loaded. By itself a thread
    spins 300,000 times, and far less where there are more threads than cores; but it knows of those of its own process
    only.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", "1000")


_wait_calmly()
