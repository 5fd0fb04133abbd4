"""§11.2's metrics against closed forms and scikit-image; the pose error against known motions."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from skimage.metrics import structural_similarity
from torch import Tensor

from refield.evaluate import EvaluateConfig, Report, evaluate, pose_error, rescored
from refield.field.encoding import Contraction
from refield.field.render import render_frame
from refield.field.sampling import OccupancySampler
from refield.scene import pose
from refield.scene.camera import Camera
from refield.scene.capture import Capture, Frame
from refield.scene.errors import InputError
from refield.scene.images import write_image
from refield.scene.transforms_json import save_transforms
from refield.vision.alignment import align
from refield.vision.similarity import psnr, ssim, ssim_in_box

W, H = 40, 30
BOX_IN = (slice(8, 20), slice(4, 17))  # 12 x 13 pixels
BOX_OUT = (slice(10, 22), slice(24, 37))


class Stripes:
    """A solid ball of soft stripes; ``gain`` darkens it."""

    def __init__(self, gain: float = 1.0) -> None:
        self.gain = gain
        space = Contraction(torch.zeros(3), 2.0)
        self.sampler = OccupancySampler(space, torch.ones(16, 16, 16, dtype=torch.uint8), step=0.05, far=3.0)

    def density(self, x: Tensor) -> Tensor:
        return torch.where(x.norm(dim=-1) < 1, 200.0, 0.0)

    def __call__(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        return self.density(x), (0.5 + 0.3 * torch.sin(4 * x)) * self.gain


def picture(seed: int, h: int = 48, w: int = 64) -> Tensor:
    """Smooth structure with noise on top."""
    g = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, 8, 8, generator=g)
    smooth = torch.nn.functional.interpolate(coarse, (h, w), mode="bicubic", align_corners=False)[0]
    return (smooth + 0.05 * torch.randn(3, h, w, generator=g)).clamp(0, 1).permute(1, 2, 0)


def capture(folder: Path, views: int = 2) -> Capture:
    camera = Camera(W, H, 40.0, 40.0, W / 2, H / 2)
    frames = []
    for i in range(views):
        at = pose.exp(torch.tensor([0.05 * i, 0, 0, 0, 0.02 * i, 0], dtype=torch.float64))
        at[2, 3] -= 2.5
        name = f"images/v{i}.png"
        frames.append(Frame(path=folder / name, camera=camera, name=name, world_from_cam=at))
    return Capture(tuple(frames), held_out_every=0)


def dataset(folder: Path, truth: Stripes, brighten_in: float = 0.0, masks: bool = True) -> Path:
    """Images of ``truth``; in the second view the pixels of the in-mask are brighter by twice as much."""
    made = capture(folder)
    for i, frame in enumerate(made.frames):
        rgb = (render_frame(truth, frame).rgb * 255).round() / 255
        rgb[BOX_IN] += brighten_in * (i + 1)
        write_image(frame.path, rgb)
        for name, box in (("masks_in", BOX_IN), ("masks_out", BOX_OUT)) if masks else ():
            mask = torch.zeros(H, W, dtype=torch.bool)
            mask[box] = True
            write_image(folder / name / f"v{i}.png", mask)
    save_transforms(folder / "transforms.json", made)
    return folder


@pytest.mark.parametrize("seed", range(4))
def test_ssim_is_scikit_images(seed: int) -> None:
    a, b = picture(seed), (picture(seed) + 0.3 * picture(seed + 100)).clamp(0, 1)
    expected = structural_similarity(
        a.double().numpy(), b.double().numpy(), gaussian_weights=True, sigma=1.5, data_range=1.0,
        use_sample_covariance=False, channel_axis=-1,
    )  # fmt: skip
    assert ssim(a, b) == pytest.approx(expected, abs=1e-9)
    assert 0.1 < expected < 0.95  # or the comparison would say little


def test_ssim_of_a_picture_with_itself_is_one() -> None:
    assert ssim(picture(0), picture(0)) == pytest.approx(1.0, abs=1e-12)


def test_psnr_of_a_constant_offset() -> None:
    a = torch.full((20, 30, 3), 0.3)
    assert psnr(a, a + 0.1) == pytest.approx(20.0, abs=1e-4)
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[3, 4] = True
    b = a.clone()
    b[3, 4] += torch.tensor([0.0, 0.0, 0.3])  # mean over three channels: 0.03
    assert psnr(b, a, mask) == pytest.approx(-10 * math.log10(0.03), abs=1e-4)
    assert psnr(b, a, ~mask) == 100.0
    assert psnr(b, a, mask & ~mask) is None


def test_ssim_in_box_sees_the_box_and_nothing_else() -> None:
    a = picture(1)
    mask = torch.zeros(a.shape[:2], dtype=torch.bool)
    mask[10, 12] = mask[30, 40] = True  # an L of two corners: most of the box is unmasked
    outside, inside = a.clone(), a.clone()
    outside[:10] = outside[31:] = 0
    outside[:, :12] = outside[:, 41:] = 0
    inside[15:25, 20:30] = 0
    assert ssim_in_box(outside, a, mask, 64) == pytest.approx(1.0)
    found = ssim_in_box(inside, a, mask, 64)
    assert found is not None and found < 0.95
    assert ssim_in_box(a, a, mask & ~mask) is None


def test_ssim_in_box_works_on_a_box_smaller_than_its_window() -> None:
    mask = torch.zeros(48, 64, dtype=torch.bool)
    mask[5:8, 5:7] = True
    assert ssim_in_box(picture(2), picture(2), mask) == pytest.approx(1.0)


def test_a_perfect_field_is_perfect_everywhere(tmp_path: Path) -> None:
    report = evaluate(Stripes(), dataset(tmp_path, Stripes()))
    for scores in (report.pooled, report.mean, *(v.scores for v in report.views)):
        assert scores.psnr == scores.psnr_in == scores.psnr_out == scores.psnr_untouched == 100.0
        assert scores.ssim_in == pytest.approx(1.0) and scores.ssim_out == pytest.approx(1.0)
        assert scores.lpips_in is scores.lpips_out is None
    assert report.pooled_before is report.mean_before is None


def test_an_error_in_one_region_counts_there_only(tmp_path: Path) -> None:
    report = evaluate(Stripes(), dataset(tmp_path, Stripes(), brighten_in=0.1))
    first, second = (v.scores for v in report.views)
    assert first.psnr_in == pytest.approx(20.0, abs=0.15)  # 0.1, rounded to 8 bits
    assert second.psnr_in == pytest.approx(-20 * math.log10(0.2), abs=0.1)
    assert first.psnr_out == first.psnr_untouched == 100.0
    both = -10 * math.log10((0.1**2 + 0.2**2) / 2)
    assert report.pooled.psnr_in == pytest.approx(both, abs=0.1)
    assert report.mean.psnr_in == pytest.approx((20 - 20 * math.log10(0.2)) / 2, abs=0.1)
    share = BOX_IN[0].stop - BOX_IN[0].start, BOX_IN[1].stop - BOX_IN[1].start
    whole = both - 10 * math.log10(share[0] * share[1] / (W * H))
    assert report.pooled.psnr == pytest.approx(whole, abs=0.1)


def test_untouched_keeps_its_distance_from_the_masks(tmp_path: Path) -> None:
    folder = dataset(tmp_path, Stripes(), brighten_in=0.1)
    mask = torch.zeros(H, W, dtype=torch.bool)
    mask[BOX_IN] = True
    mask[8] = False  # one row of the brightened pixels is left out of the mask
    for i in range(2):
        write_image(folder / "masks_in" / f"v{i}.png", mask)
    assert evaluate(Stripes(), folder, config=EvaluateConfig(margin=1)).pooled.psnr_untouched == 100.0
    near = evaluate(Stripes(), folder, config=EvaluateConfig(margin=0)).pooled.psnr_untouched
    assert near is not None and near < 45


def test_the_old_field_is_scored_on_the_same_pixels(tmp_path: Path) -> None:
    report = evaluate(Stripes(), dataset(tmp_path, Stripes()), old=Stripes(gain=0.8))
    alone = evaluate(Stripes(gain=0.8), tmp_path)
    assert report.pooled_before is not None and report.mean_before is not None
    assert asdict(report.pooled_before) == pytest.approx(asdict(alone.pooled))
    assert asdict(report.mean_before) == pytest.approx(asdict(alone.mean))
    assert report.pooled_before.psnr_in is not None and report.pooled_before.psnr_in < 30


def test_without_masks_only_the_whole_is_scored(tmp_path: Path) -> None:
    scores = evaluate(Stripes(), dataset(tmp_path, Stripes(), masks=False)).pooled
    assert scores.psnr == 100.0
    assert {k for k, v in asdict(scores).items() if v is not None} == {"psnr", "ssim"}


def test_the_report_survives_json(tmp_path: Path) -> None:
    report: Report = evaluate(Stripes(), dataset(tmp_path, Stripes()), old=Stripes(0.5))
    told = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert told["views"][1]["name"] == "images/v1.png"
    assert told["pooled"]["psnr_in"] == 100.0 and told["pooled_before"]["psnr_in"] < 30
    assert told["views"][0]["before"]["psnr_out"] < 30


def test_views_are_announced(tmp_path: Path) -> None:
    heard: list[str] = []
    evaluate(Stripes(), dataset(tmp_path, Stripes()), on_view=heard.append)
    assert heard == ["images/v0.png", "images/v1.png"]


def test_a_missing_mask_is_named(tmp_path: Path) -> None:
    folder = dataset(tmp_path, Stripes())
    (folder / "masks_out" / "v1.png").unlink()
    with pytest.raises(InputError, match=r"masks_out/v1\.png: there is no mask for images/v1\.png; add it"):
        evaluate(Stripes(), folder)


def test_a_mask_of_another_size_is_named(tmp_path: Path) -> None:
    folder = dataset(tmp_path, Stripes())
    write_image(folder / "masks_in" / "v0.png", torch.zeros(H, W + 1, dtype=torch.bool))
    with pytest.raises(InputError, match=r"v0\.png: the mask has 41x30 pixels, its image 40x30"):
        evaluate(Stripes(), folder)


def test_alignment_undoes_a_small_shift() -> None:
    big = picture(3, 120, 160)
    photo, shifted = big[10:90, 10:130].numpy(), big[12:92, 9:129].numpy()
    aligned = align(shifted, photo)
    inner = (slice(4, -4), slice(4, -4))
    before = float(((shifted - photo)[inner] ** 2).mean())
    assert float(((aligned - photo)[inner] ** 2).mean()) < before / 5


def test_alignment_leaves_unrelated_pictures_alone() -> None:
    image = picture(4).numpy()
    assert (align(image, picture(5).numpy()) == image).all()


def test_alignment_is_off_unless_asked_for(tmp_path: Path) -> None:
    folder = dataset(tmp_path, Stripes())
    made = capture(folder)
    off = made.frames[0].world_from_cam.clone()
    off[0, 3] += 0.06  # about a pixel
    wrong = Frame(made.frames[0].path, made.frames[0].camera, made.frames[0].name, off)
    save_transforms(folder / "transforms.json", Capture((wrong,), held_out_every=0))
    plain = evaluate(Stripes(), folder).pooled.psnr_in
    aligned = evaluate(Stripes(), folder, config=EvaluateConfig(align=True)).pooled.psnr_in
    assert plain is not None and aligned is not None and aligned > plain + 3


def test_pose_error_is_measured_at_the_object() -> None:
    true = pose.exp(torch.tensor([0.2, 0.2, 0, 0, 0, 0.5], dtype=torch.float64))
    centre = torch.tensor([3.0, -1.0, 0.5], dtype=torch.float64)
    assert pose_error(true, true, centre) == pytest.approx((0, 0), abs=1e-6)
    shift = torch.eye(4, dtype=torch.float64)
    shift[:3, 3] = torch.tensor([0.03, 0.0, 0.04])
    assert pose_error(shift @ true, true, centre) == pytest.approx((0.05, 0), abs=1e-6)
    # a turn about the object's own new centre moves that centre nowhere, wherever the world's origin lies
    now = pose.transform(true, centre)
    turn = pose.exp(torch.tensor([0, 0, 0, 0, math.radians(2), 0], dtype=torch.float64))
    about = pose.rigid(turn[:3, :3], now - turn[:3, :3] @ now)
    assert pose_error(about @ true, true, centre) == pytest.approx((0, 2.0), abs=1e-6)


def test_lpips_is_of_the_masks_boxes_and_left_out_without_weights(tmp_path: Path) -> None:
    """With a stand-in that measures the mean difference: the boxes are those of SSIM."""

    def mean_difference(image: Tensor, truth: Tensor) -> float:
        assert image.shape == truth.shape == (64, 64, 3)
        return float((image - truth).abs().mean())

    folder = dataset(tmp_path, Stripes(), brighten_in=0.1)
    config = EvaluateConfig(crop=64)
    report = evaluate(Stripes(), folder, old=Stripes(0.5), config=config, perceptual=mean_difference)
    assert [v.scores.lpips_in for v in report.views] == pytest.approx([0.1, 0.2], abs=0.01)
    assert report.pooled.lpips_in == pytest.approx(0.15, abs=0.01) and report.pooled.lpips_out == 0
    assert report.pooled_before is not None and (report.pooled_before.lpips_out or 0) > 0.1
    assert evaluate(Stripes(), folder).pooled.lpips_in is None


def test_other_pictures_of_the_same_views(tmp_path: Path) -> None:
    report = evaluate(Stripes(), dataset(tmp_path, Stripes()), old=Stripes(0.5))
    worse = [v.truth.clone() for v in report.views]
    for picture in worse:
        picture[BOX_OUT] += 0.1
    other = rescored(report, worse)
    assert other.pooled.psnr_in == 100.0 and other.pooled.psnr_out == pytest.approx(20.0, abs=0.2)
    assert other.pooled_before is None and other.views[0].render_before is None
    with pytest.raises(ValueError):
        rescored(report, worse[:1])


def test_ssim_of_whole_views(tmp_path: Path) -> None:
    report = evaluate(Stripes(0.9), dataset(tmp_path, Stripes()))
    each = [ssim(v.render, v.truth) for v in report.views]
    assert [v.scores.ssim for v in report.views] == each
    assert report.pooled.ssim == pytest.approx(sum(each) / len(each)) and report.pooled.ssim < 1
