"""Worlds we know exactly, so that everything can be checked; and a small ready-made sample of one."""

from __future__ import annotations

from pathlib import Path

from refield.scene.errors import InputError

__all__ = ["sample_folder"]


def sample_folder() -> Path:
    """The packaged sample: ``before/``, ``after/``, ``eval/``, ``truth/``.

    Made by ``refield synth table OUT --size 144 --spp 128 --cameras 70``, less its depths.

    Raises:
        InputError: the package was installed without its data.
    """
    folder = Path(__file__).parent / "sample"
    if not (folder / "before" / "transforms.json").is_file():
        raise InputError(folder, "the sample is missing from the package", "reinstall refield")
    return folder
