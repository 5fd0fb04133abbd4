"""Photos with their poses, for others: transforms.json (nerfstudio, instant-ngp), a COLMAP model, glTF cameras.

Each set of photos is a folder of its own that needs nothing from outside: those of the capture, which show how things
were, and those of each visit.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from refield.export.gltf import Glb
from refield.scene.capture import Capture
from refield.scene.colmap import save_colmap
from refield.scene.files import write_bytes
from refield.scene.intrinsics import write_camera
from refield.scene.transforms_json import opengl_pose, save_transforms, stem
from refield.scene.world import World


def write_cameras(folder: Path, capture: Capture, world: World) -> list[Path]:
    """``transforms.json``, ``sparse/0`` (COLMAP, binary), ``cameras.glb`` and copies of the photos in ``images``."""
    (folder / "images").mkdir(parents=True)
    copies = [folder / "images" / frame.path.name for frame in capture.frames]
    for frame, copy in zip(capture.frames, copies):
        shutil.copyfile(frame.path, copy)
    kept = replace(capture, frames=tuple(replace(f, path=p) for f, p in zip(capture.frames, copies)))
    save_transforms(folder / "transforms.json", kept)
    save_colmap(folder / "sparse" / "0", kept)
    file = Glb(world, {"distortion": "in transforms.json: glTF's cameras have none"})
    for frame in kept.frames:
        lens = file.add_camera(frame.camera)
        file.add_node(stem(frame), opengl_pose(frame.world_from_cam), camera=lens, extras=write_camera(frame.camera))
    write_bytes(folder / "cameras.glb", file.to_bytes())
    return [p for p in sorted(folder.rglob("*")) if p.is_file()]
