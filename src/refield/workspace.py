"""The folder in which a field lives: capture, field, visits. Every artefact's place, each put there whole.

    WORK/  refield.json   capture/{transforms.json,refined.json,images/,world.json,landmarks.safetensors}
           field/{field.safetensors,field.json}
           visits/001/{change.json, grid_0.npz, masks/, photos/, field.safetensors, report.json, report.html}

``refield.json`` is written last and marks a complete workspace. New artefacts are built in ``.part-*`` and
renamed, so that what is visible is whole; one process at a time writes (``.lock``).
"""

from __future__ import annotations

import contextlib
import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from refield.artefacts import (
    LOCK,
    PART,
    locked,
    need_space,
    need_writable,
    part_folder,
    read_tensors,
    sync,
    sync_folder,
    writable,
    write_tensors,
)
from refield.field.nerfacto import NerfactoField
from refield.field.nerfstudio import NerfstudioField
from refield.field.radiance import HashField
from refield.scene.capture import Capture, Frame
from refield.scene.change import PlacedPhoto, SceneChange
from refield.scene.change_files import load_change, save_change
from refield.scene.errors import InputError
from refield.scene.files import AnyPath, as_path, read_json, write_json
from refield.scene.refined import NAME as REFINED
from refield.scene.refined import refined, write_refined
from refield.scene.transforms_json import load_transforms, save_transforms
from refield.scene.world import World, world_of

__all__ = ["Workspace", "load_change", "refuse_inside", "save_change"]

MARKER, WORLD = "refield.json", "world.json"
FORMAT = 1
CACHE = ".photos"
"""what structure from motion has found, kept while it goes on and for the next time; may be deleted"""
Fitted = HashField | NerfactoField | NerfstudioField
"""the field before any visit, of any architecture"""
_ARCHITECTURES: dict[str, type[Fitted]] = {c.__name__: c for c in (HashField, NerfactoField, NerfstudioField)}
VIEWED = ".view"
"""what the browser is shown of each state, kept for the next time; may be deleted"""
_OURS = (MARKER, "capture", "field", "visits")


def refuse_inside(*paths: Path) -> None:
    """Check that ``paths``, where the user wants something written, can be written, and that none of them is what a
    workspace keeps or lies in it.

    A name of the user's own beside a workspace's entries is free. Links are followed.

    Raises:
        InputError: one cannot, or is.
    """
    for path in paths:
        try:
            place = path.resolve()
        except (OSError, RuntimeError):  # a loop of links
            raise InputError(path, "cannot be resolved", "check the path and its links") from None
        for root in place.parents:
            # some file systems know no case
            name = place.relative_to(root).parts[0].casefold()
            if _is_kept(name) and _is_workspace(root):
                what = f"belongs to the workspace {root}: nothing but refield's own steps writes there"
                raise InputError(path, what, "choose another place, outside of what a workspace keeps")
        need_writable(path)


class Workspace:
    """An open workspace. Make one by :meth:`building`, find one by :meth:`open`."""

    def __init__(self, path: AnyPath) -> None:
        self.path = as_path(path, "the workspace")

    def __repr__(self) -> str:
        return f"Workspace({str(self.path)!r})"

    @staticmethod
    def open(path: AnyPath) -> Workspace:
        """An existing workspace.

        Raises:
            InputError: ``path`` is not one, or of a newer format.
        """
        path = as_path(path, "the workspace")
        if not (path / MARKER).is_file():
            what = "is not a refield workspace" if path.exists() else "there is no such workspace"
            raise InputError(path, what, f"make one with: refield train DATA {path}")
        version = read_json(path / MARKER).get("format")
        if version != FORMAT:
            what = f"has the workspace format {version!r}; this refield reads {FORMAT}"
            raise InputError(path / MARKER, what, "use the refield that wrote it, or train again")
        return Workspace(path)

    @staticmethod
    def refuse_unless_free(path: AnyPath, *, overwrite: bool, option: str | None = "--overwrite") -> None:
        """Check that a workspace may be made at ``path``, before any work. ``option``: the command's that would allow
        what is refused; None if it has none.

        Raises:
            InputError: something is there that we did not write, or a workspace and not ``overwrite``; or it lies in
                what another workspace keeps.
        """
        path = as_path(path, "the workspace")
        refuse_inside(path)
        if path.exists() and not path.is_dir():
            raise InputError(path, "is a file, not a folder", "choose another output folder")
        entries = [p for p in path.iterdir() if not _is_hidden(p.name)] if path.exists() else []
        if (path / MARKER).is_file():
            if not overwrite:
                what = "already holds a refield workspace"
                raise InputError(path, what, f"choose another folder{f', or pass {option}' if option else ''}")
            return
        clash = [p.name for p in entries if p.name in _OURS]
        if clash:
            what = f"holds {', '.join(clash)} but is not a refield workspace"
            raise InputError(path, what, "choose another output folder")
        if entries and not overwrite:
            what = f"is not empty and not a refield workspace ({entries[0].name}, …)"
            more = f", or pass {option} to add to it" if option else ""
            raise InputError(path, what, f"choose an empty output folder{more}")

    @staticmethod
    @contextlib.contextmanager
    def building(path: AnyPath, *, overwrite: bool = False, made_by: str = "train") -> Iterator[Workspace]:
        """A new workspace under construction: fill it with `keep_capture` and `keep_field`.

        It appears at ``path`` when the block ends well, not at all otherwise. What else lies there stays.
        """
        path = as_path(path, "the workspace")
        Workspace.refuse_unless_free(path, overwrite=overwrite)
        made = _missing(path)
        with writable(path):
            path.mkdir(parents=True, exist_ok=True)
        try:
            with locked(path), part_folder(path) as part:
                yield Workspace(part)
                write_json(part / MARKER, {"format": FORMAT, "made_by": made_by})
                sync(part)
                _swap_in(path, part)
        finally:
            if made and not (path / MARKER).exists():
                _unmake(made)

    @staticmethod
    @contextlib.contextmanager
    def caching(path: AnyPath) -> Iterator[Path]:
        """The folder, made if need be, in which a workspace that is to be made at ``path`` keeps what takes long.

        Unlike the workspace it is there from the beginning, so that what was interrupted goes on.
        """
        path = as_path(path, "the workspace")
        refuse_inside(path)
        made = _missing(path)
        with writable(path):
            (path / CACHE).mkdir(parents=True, exist_ok=True)
        try:
            with locked(path):
                yield path / CACHE
        finally:
            if not any((path / CACHE).iterdir()):
                (path / CACHE).rmdir()
                if made:
                    _unmake(made)

    @property
    def cache(self) -> Path:
        """As `caching`, of a workspace that is there; call under the lock."""
        with writable(self.path):
            (self.path / CACHE).mkdir(exist_ok=True)
        return self.path / CACHE

    @property
    def landmarks(self) -> Path:
        """The file of what new photos are placed by, which need not exist (`refield.photos.landmarks`)."""
        return self.path / "capture" / "landmarks.safetensors"

    def keep_world(self, world: World) -> None:
        """Write what is known of the capture's world beside it."""
        write_json(self.path / "capture" / WORLD, world.to_dict())

    def world(self) -> World:
        """What is known of the capture's world; found out anew where it was not written."""
        path = self.path / "capture" / WORLD
        return World.from_dict(read_json(path), path) if path.is_file() else world_of(self.capture())

    @staticmethod
    def made_by(path: AnyPath) -> str | None:
        """The command that made the workspace at ``path``; None if there is none."""
        path = as_path(path, "the workspace")
        return read_json(path / MARKER).get("made_by") if (path / MARKER).is_file() else None

    def keep_capture(self, capture: Capture) -> Capture:
        """Copy the photos in (named by index), so that the workspace needs nothing from outside; the copy."""
        size = sum(f.path.stat().st_size for f in capture.frames)
        need_space(self.path, size)
        folder = self.path / "capture"
        copied = replace(capture, frames=_copy_photos(folder, capture.frames))
        save_transforms(folder / "transforms.json", copied)
        return copied

    def capture(self) -> Capture:
        """The photos that the field was fitted to, with what the fit found out about them."""
        return refined(self.given_capture(), self.path / "capture" / REFINED)

    def given_capture(self) -> Capture:
        """The photos that the field was fitted to, as they were given."""
        return load_transforms(self.path / "capture", decode=False)

    def keep_refined(self, given: Capture, found: Capture) -> None:
        """Note what the fit found out about the photos of the capture kept here, see `refield.scene.refined`."""
        # the photos have names of their own here
        names = {f.name: kept.name for f, kept in zip(given.frames, self.given_capture().frames)}
        parts = (replace(c, frames=tuple(replace(f, name=names[f.name]) for f in c.frames)) for c in (given, found))
        write_refined(self.path / "capture" / REFINED, *parts)

    def keep_field(self, field: Fitted, psnr: float = math.nan) -> None:
        """Write the fitted field and, if known, its PSNR on held-out pixels (dB)."""
        tensors, facts = field.state()
        facts["held_out_psnr"] = psnr if math.isfinite(psnr) else None
        write_tensors(self.path / "field", tensors, facts)

    def held_out_psnr(self) -> float:
        """Of the field before any visit, dB; NaN if it is not known."""
        known = read_json(self.path / "field" / "field.json").get("held_out_psnr")
        return float(known) if isinstance(known, int | float) else math.nan

    def field(self) -> Fitted:
        """The field before any visit."""
        folder = self.path / "field"
        tensors, facts = read_tensors(folder)
        try:
            return _ARCHITECTURES[facts["architecture"]].from_state(tensors, facts)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise InputError(folder, f"does not describe a field ({error})", "train again") from None

    @property
    def visits(self) -> int:
        """How many there are; they are numbered from 1 without gaps."""
        count = 0
        while self.visit(count + 1).is_dir():
            count += 1
        return count

    def visit(self, number: int) -> Path:
        """The folder of a visit, which need not exist."""
        return self.path / "visits" / f"{number:03d}"

    def chosen_visit(self, number: int | None) -> int:
        """``number``, or the latest visit for None; 0 is the state before any.

        Raises:
            InputError: there is no such visit.
        """
        last = self.visits
        if number is None:
            return last
        if not 0 <= number <= last:
            raise InputError(self.path, f"there is no visit {number}", f"give one of 0 (before) to {last}")
        return number

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """Hold the lock.

        Raises:
            InputError: another process holds it, or the folder cannot be written.
        """
        with locked(self.path):
            yield

    @contextlib.contextmanager
    def new_visit(self) -> Iterator[Path]:
        """A folder to build the next visit in; it gets its number when the block ends well, or vanishes."""
        base = self.path / "visits"
        with writable(base):
            base.mkdir(exist_ok=True)
        with part_folder(base) as part:
            yield part
            sync(part)
            part.rename(self.visit(self.visits + 1))
            sync_folder(base)

    def drop_last_visit(self) -> None:
        """Remove the latest visit, whole: it goes out of sight by one rename. Call under the lock."""
        base, last = self.path / "visits", self.visit(self.visits)
        with part_folder(base) as part:
            last.rename(part / last.name)
            sync_folder(base)

    def keep_change(self, folder: Path, change: SceneChange) -> SceneChange:
        """Copy the used photos into a visit's folder and write the change; the change with the copies.

        Where nothing changed there is nothing to keep but that.
        """
        if not change.objects:
            save_change(folder, replace(change, masks_in=(), masks_out=()))
            return change
        frames = _copy_photos(folder / "photos", change.frames) if change.frames else ()
        if frames:
            save_transforms(folder / "photos" / "transforms.json", Capture(frames, held_out_every=0))
        rest = iter(frames)
        photos = tuple(p if p.frame is None else _photo_at(p, next(rest)) for p in change.photos)
        kept = replace(change, photos=photos)
        save_change(folder, kept)
        return kept

    def change(
        self, number: int, capture: Capture | None = None, *, masks: bool = True, old_masks: bool = True
    ) -> SceneChange:
        """What changed at a visit; see `load_change`."""
        return load_change(self.visit(number), capture, masks=masks, old_masks=old_masks)


def _copy_photos(folder: Path, frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """The same frames with their image files at ``folder/images/0000.png`` and on."""
    out = []
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for i, frame in enumerate(frames):
        name = f"images/{i:04d}{frame.path.suffix.lower()}"
        shutil.copyfile(frame.path, folder / name)
        out.append(replace(frame, path=folder / name))
    return tuple(out)


def _photo_at(photo: PlacedPhoto, frame: Frame) -> PlacedPhoto:
    return replace(photo, frame=frame)


def _missing(path: Path) -> list[Path]:
    """The folder ``path`` and those above it, as far as they are not there yet."""
    return [p for p in (path, *path.parents) if not p.exists()]


def _unmake(made: Sequence[Path]) -> None:
    """Remove a folder, and those above it that were made for it and are empty."""
    shutil.rmtree(made[0], ignore_errors=True)
    with contextlib.suppress(OSError):
        for above in made[1:]:
            above.rmdir()


def _is_hidden(name: str) -> bool:
    return name in (LOCK, CACHE, VIEWED) or name.startswith(PART)


def _is_kept(name: str) -> bool:
    """Whether a workspace's entry of this name is written by refield alone."""
    return name in _OURS or _is_hidden(name)


def _is_workspace(folder: Path) -> bool:
    """Whether a workspace is there, or one in the making."""
    return (folder / MARKER).is_file() or ((folder / CACHE).is_dir() and (folder / LOCK).is_file())


def _swap_in(path: Path, part: Path) -> None:
    """Move a finished workspace's entries from ``part`` to ``path``; undone if anything stops it half-way."""
    old = part / "old"
    old.mkdir()
    moves = [(path / name, old / name) for name in _OURS]
    moves += [(part / name, path / name) for name in reversed(_OURS)]  # the marker goes first and comes last
    done: list[tuple[Path, Path]] = []
    try:
        for source, target in moves:
            if source.exists():
                source.rename(target)
                done.append((source, target))
        sync_folder(path)
    except BaseException:
        for source, target in reversed(done):
            target.rename(source)
        raise
