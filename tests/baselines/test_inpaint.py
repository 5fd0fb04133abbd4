"""In-painting: what is kept, what is made up, and LaMa's place in it, with a tiny network in its stead."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from refield.baselines.inpaint import Diffusion, Lama, inpaint
from refield.scene.errors import InputError
from refield.vision.similarity import psnr
from tests.baselines.onnx_model import lama_like

MASK = torch.zeros(60, 80, dtype=torch.bool)
MASK[20:40, 30:50] = True


def ramp() -> torch.Tensor:
    y, x = torch.meshgrid(torch.linspace(0, 1, 60), torch.linspace(0, 1, 80), indexing="ij")
    return torch.stack([x, y, 0.5 * (x + y)], -1)


@pytest.mark.parametrize("method", ["telea", "navier-stokes"])
def test_a_smooth_picture_is_filled_in_smoothly(method: str) -> None:
    truth = ramp()
    holed = torch.where(MASK[..., None], torch.tensor([1.0, 0.0, 0.0]), truth)
    out = inpaint(holed, MASK, Diffusion(method))  # type: ignore[arg-type]
    assert psnr(out, truth, MASK) > 25 > psnr(holed, truth, MASK)
    assert torch.equal(out[~MASK], holed[~MASK])


def test_an_objects_rim_is_not_looked_at() -> None:
    """Pixels beside the mask that still show the object do not colour what is made up."""
    truth, rim = ramp(), torch.zeros_like(MASK)
    rim[18:42, 28:52] = True
    holed = torch.where(rim[..., None], torch.tensor([1.0, 0.0, 0.0]), truth)
    near, past = (psnr(inpaint(holed, MASK, margin=m), truth, MASK) for m in (0, 2))
    assert past > near + 5
    assert torch.equal(inpaint(holed, MASK, margin=2)[~rim], holed[~rim])


def test_without_a_mask_nothing_happens() -> None:
    assert torch.equal(inpaint(ramp(), torch.zeros_like(MASK)), ramp())


def test_lama_sees_the_picture_and_the_mask(tmp_path: Path) -> None:
    """The stand-in answers 255 (1 - image) in the mask and 255 image elsewhere."""
    (tmp_path / "lama.onnx").write_bytes(lama_like())
    truth = ramp()
    out = inpaint(truth, MASK, Lama(tmp_path / "lama.onnx"))
    assert torch.equal(out[~MASK], truth[~MASK])
    inner = torch.zeros_like(MASK)
    inner[22:38, 32:48] = True
    np.testing.assert_allclose(out[inner], 1 - truth[inner], atol=0.02)


def test_lamas_faults_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.onnx: there is no such file; give inpainting_lama"):
        Lama(tmp_path / "none.onnx")
    (tmp_path / "bad.onnx").write_bytes(b"not a model at all")
    with pytest.raises(InputError, match=r"bad\.onnx: .*ONNX"):
        Lama(tmp_path / "bad.onnx")
    (tmp_path / "names.onnx").write_bytes(lama_like(inputs=("left", "right")))
    with pytest.raises(InputError, match="does not take an image and a mask"):
        inpaint(ramp(), MASK, Lama(tmp_path / "names.onnx"))
    (tmp_path / "shape.onnx").write_bytes(lama_like(flat=True))
    with pytest.raises(InputError, match=r"answers \(1, 786432\) in place of"):
        inpaint(ramp(), MASK, Lama(tmp_path / "shape.onnx"))
