"""``refield import RUN WORK``: a trained ``nerfacto`` of nerfstudio and its photos → a workspace."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.commands.answer import Answer
from refield.commands.clock import Clock
from refield.commands.options import PLAIN, Output
from refield.commands.train import check_scale
from refield.field.nerfstudio import NerfstudioField
from refield.field.render import render_many
from refield.nerfstudio.checkpoint import read_model
from refield.nerfstudio.placing import placing_of, trained_on, with_poses
from refield.nerfstudio.run import TAG, Run, read_run
from refield.nerfstudio.weights import field_of
from refield.scene.capture import Capture, Frame, Rays, camera_rays
from refield.scene.errors import InputError
from refield.scene.images import frame_image, opened
from refield.scene.refined import in_words
from refield.scene.transforms_json import load_transforms
from refield.scene.world import world_of
from refield.workspace import Workspace

POOR = 15.0
"""dB; a field that shows its photos worse does not belong to them"""
_PIXELS = 4096  # on which it is measured
EXAMPLES = ("refield import outputs/room/nerfacto/2024-05-01_101010 work",)


@dataclass(frozen=True)
class Import:
    """Take over a field that nerfstudio's nerfacto has trained: it shows what nerfstudio shows, and can be updated."""

    run: Annotated[Path, arg(metavar="RUN"), Positional]
    """a run of ns-train nerfacto: outputs/NAME/nerfacto/DATE, or its config.yml"""
    work: Annotated[Path, arg(metavar="WORK"), Positional]
    """the workspace to make"""
    data: Path | None = None
    """the folder with the transforms.json that the run was trained on, or that file; by default as config.yml says"""
    step: int | None = None
    """the checkpoint's; the last one by default"""
    occupancy: int = 128
    """cells a side of the grid of where something may be, by which an update marches; fewer are found sooner"""
    overwrite: bool = False
    """replace the workspace that is there, with its visits"""
    scale: float | None = None
    """metres per unit of the transforms.json, if you know them: lengths are then told in metres too"""
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Import) -> Answer:
    clock = Clock(quiet=options.output.quiet, verbose=options.output.verbose)
    check_scale(options.scale)
    if not 4 <= options.occupancy <= 512:
        raise InputError("--occupancy", f"{options.occupancy} cells a side is no grid", "give 4 to 512, 128 is usual")
    Workspace.refuse_unless_free(options.work, overwrite=options.overwrite)
    clock.stage("read the run")
    source = read_run(options.run)
    checkpoint, transforms = source.checkpoint(options.step), source.data(options.data)
    placing = placing_of(source, transforms)
    capture = load_transforms(transforms, warn=clock.warn)
    state = read_model(checkpoint)
    white = not _is_transparent(capture.frames[0])
    field = field_of(state, source.model, placing, checkpoint, white)
    split = trained_on(source, capture, transforms)
    adjustment = state.get("camera_optimizer.pose_adjustment")
    found = capture
    if adjustment is not None and split is not None and len(split[0]) == len(adjustment):
        found = with_poses(capture, placing, split[0], adjustment, _mode(source))
    elif adjustment is not None:
        clock.warn("which photo each refined pose belongs to cannot be told; the poses stay as they were given")
    clock.stage("look where something is")
    field.looking_around(options.occupancy)
    psnr = _measured(field, found, split, clock)
    with Workspace.building(options.work, overwrite=options.overwrite, made_by="import") as workspace:
        clock.stage("keep the photos and the field")
        workspace.keep_world(world_of(workspace.keep_capture(capture), options.scale))
        workspace.keep_field(field, psnr)
        workspace.keep_refined(capture, found)
    clock.stop()
    if said := in_words(capture, found):
        clock.console.print(f"           of the photos: {said}", markup=False)
    shown = "" if math.isnan(psnr) else f"{psnr:.2f} dB on photos left out, "
    document = {"workspace": options.work, "photos": len(found.frames), "held_out_psnr": psnr}
    document |= {"seconds_per_stage": clock.seconds, "warnings": clock.warnings}
    return Answer(document, [f"The field is in {options.work} ({shown}{clock.total:.1f} s)."])


def _measured(
    field: NerfstudioField, capture: Capture, split: tuple[list[int], list[int]] | None, clock: Clock
) -> float:
    """PSNR on photos that the run left out, dB; NaN where none are known. Warns where the field is not theirs."""
    clock.stage("compare with the photos")
    left_out = [capture.frames[i] for i in split[1]] if split is not None else []
    psnr = shown_psnr(field, left_out or list(capture.frames))
    if psnr < POOR:
        where = capture.frames[0].path.parent
        clock.warn(f"the field shows the photos in {where} at {psnr:.1f} dB only: was it trained on these?")
    return psnr if left_out else math.nan


def shown_psnr(field: NerfstudioField, frames: list[Frame]) -> float:
    """How well a field shows photos, at some random pixels of 16 of them at most, dB."""
    generator = torch.Generator().manual_seed(0)
    chosen = frames[:: math.ceil(len(frames) / 16)]
    rays, colours = [], []
    for frame in chosen:
        camera = frame.camera
        at = torch.rand(_PIXELS // len(chosen), 2, generator=generator) * torch.tensor([camera.width, camera.height])
        column, row = at.long().unbind(-1)
        colours.append(frame_image(frame)[row, column].float() / 255)
        rays.append(camera_rays(camera, frame.world_from_cam, torch.stack([column, row], -1) + 0.5))
    together = Rays(torch.cat([r.origins for r in rays]), torch.cat([r.directions for r in rays]))
    error = (render_many(field, together, 2048).rgb - torch.cat(colours)).square().mean()
    return -10 * math.log10(max(float(error), 1e-10))


def _mode(source: Run) -> str:
    """Of the camera optimiser."""
    told = source.model.get("camera_optimizer")
    return str(told.get("mode", "SO3xR3")) if isinstance(told, dict) and TAG in told else "SO3xR3"


def _is_transparent(frame: Frame) -> bool:
    with opened(frame.path) as image:
        return image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info
