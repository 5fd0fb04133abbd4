"""LightGlue and SuperGlue with small random weights: what surrounds the networks, and opening them from a folder."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from refield.vision import pixels
from refield.vision.lightglue import LightGlueMatcher, in_pixels, matched, to_grey
from refield.vision.weights import MATCHERS, WeightsError

transformers = pytest.importorskip("transformers")

SIZE = (64, 96)
SIZES = [(64, 96), (48, 31), (200, 300), (9, 300), (7, 7)]


def model(kind):
    """As small as it gets; orthogonal weights, since the usual small random ones make every point alike."""
    torch.manual_seed(0)
    detector = transformers.SuperPointConfig(
        encoder_hidden_sizes=[4, 4, 8, 8],
        decoder_hidden_size=8,
        descriptor_decoder_dim=16,
        max_keypoints=24,
        keypoint_threshold=0.0,
    )
    if kind == "lightglue":
        config = transformers.LightGlueConfig(
            keypoint_detector_config=detector,
            descriptor_dim=16,
            num_hidden_layers=2,
            num_attention_heads=2,
            filter_threshold=0.0,
        )
        found = transformers.LightGlueForKeypointMatching(config)
    else:
        config = transformers.SuperGlueConfig(
            keypoint_detector_config=detector,
            hidden_size=16,
            keypoint_encoder_sizes=[8, 16],
            gnn_layers_types=["self", "cross"],
            num_attention_heads=2,
            sinkhorn_iterations=5,
        )
        found = transformers.SuperGlueForKeypointMatching(config)
    for parameter in found.parameters():
        if parameter.dim() > 1:
            torch.nn.init.orthogonal_(parameter)
    return found


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Networks this small are slower on several."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("weights")
    transformers.utils.logging.disable_progress_bar()
    for kind in MATCHERS:
        model(kind).save_pretrained(root / kind)
    transformers.utils.logging.enable_progress_bar()
    return root


@pytest.fixture(params=list(MATCHERS))
def matcher(folders, request):
    opened = MATCHERS[request.param](folders / request.param, "cpu")
    return LightGlueMatcher(opened.model, threshold=0.0, size=SIZE)


def picture(size, seed=0):
    rng = np.random.default_rng(seed)
    return pixels.to_bytes(pixels.blur(rng.random((*size, 3)).astype(np.float32), 1.0) * 3 - 1)


def answer(keypoints, matches, scores, mask=None):
    """A network's output for one pair; keypoints (2, K, 2), the rest (K,) of the first image."""
    keypoints = torch.tensor(keypoints, dtype=torch.float32)
    count = keypoints.shape[1]
    back = torch.full((count,), -1)
    return SimpleNamespace(
        keypoints=keypoints[None],
        matches=torch.stack([torch.tensor(matches), back])[None],
        matching_scores=torch.stack([torch.tensor(scores), torch.zeros(count)])[None],
        mask=torch.ones(1, 2, count, dtype=torch.int) if mask is None else torch.tensor(mask)[None],
    )


def test_points_lie_in_their_images_and_scores_in_0_1(matcher):
    a, b = picture((70, 90)), picture((50, 40), seed=1)
    for first, second in [(a, a), (a, b), (b, a), (b, b)]:
        xy_a, xy_b, score = matcher.match(first, second)
        assert xy_a.shape == xy_b.shape == (len(score), 2)
        assert xy_a.dtype == xy_b.dtype == score.dtype == np.float64
        assert (score > 0).all() and (score <= 1).all()
        for xy, image in ((xy_a, first), (xy_b, second)):
            assert (xy > 0).all() and (xy < [image.shape[1], image.shape[0]]).all()
    assert len(matcher.match(a, a)[0])


def test_the_threshold_is_kept(matcher):
    a = picture((70, 90))
    everything = matcher.match(a, a)[2]
    limit = float(np.median(everything))
    fewer = LightGlueMatcher(matcher.model, threshold=limit, size=SIZE).match(a, a)[2]
    np.testing.assert_allclose(np.sort(fewer), np.sort(everything[everything > limit]))


def test_no_keypoints_no_matches(matcher, monkeypatch):
    monkeypatch.setattr(matcher.model.keypoint_detector.keypoint_decoder, "keypoint_threshold", 2.0)
    xy_a, xy_b, score = matcher.match(picture((70, 90)), picture((70, 90), seed=1))
    assert xy_a.shape == xy_b.shape == (0, 2) and score.shape == (0,)


@pytest.mark.parametrize("size", SIZES)
def test_images_are_prepared_as_transformers_does(size):
    reference = transformers.LightGlueImageProcessorPil(size={"height": SIZE[0], "width": SIZE[1]})
    grey = np.repeat(picture(size)[..., :1], 3, -1)
    pair = [picture(size), grey]
    told = reference([Image.fromarray(p) for p in pair], return_tensors="pt")["pixel_values"][0]
    for ours, theirs in zip([to_grey(p, SIZE) for p in pair], told):
        torch.testing.assert_close(ours, theirs.float(), atol=1e-6, rtol=0)


def test_pixels_are_transformers_plus_a_half_where_nothing_is_resized():
    """transformers cuts fractions of a pixel off and counts from the centre of the first pixel."""
    at = np.array([[[3, 5], [40, 60], [95, 63]], [[10, 12], [0, 0], [50, 33]]])
    out = answer((at + 1e-3) / [SIZE[1], SIZE[0]], [2, -1, 0], [0.9, 0.8, 0.3])
    reference = transformers.LightGlueImageProcessorPil().post_process_keypoint_matching(out, [(SIZE, SIZE)], 0.2)[0]
    a, b, score = matched(out, 0.2)
    np.testing.assert_allclose(in_pixels(a, SIZE, SIZE), reference["keypoints0"] + 0.5, atol=2e-3)
    np.testing.assert_allclose(in_pixels(b, SIZE, SIZE), reference["keypoints1"] + 0.5, atol=2e-3)
    torch.testing.assert_close(score, reference["matching_scores"])


@pytest.mark.parametrize("size", [(128, 192), (32, 48), (100, 60)])
def test_a_spot_is_found_where_it_is_after_resizing(size):
    """The brightest pixel that the network sees, taken for its keypoint, is the spot's centre in the image."""
    yy, xx = np.mgrid[: size[0], : size[1]] + 0.5
    spot = np.array([0.3 * size[1], 0.6 * size[0]])
    apart = ((xx - spot[0]) / size[1]) ** 2 + ((yy - spot[1]) / size[0]) ** 2
    image = np.repeat(pixels.to_bytes(np.exp(-apart * 200))[..., None], 3, -1)
    seen = to_grey(image, SIZE)[0]
    weight = seen / seen.sum()
    index = torch.stack([(weight.sum(0) * torch.arange(SIZE[1])).sum(), (weight.sum(1) * torch.arange(SIZE[0])).sum()])
    found = in_pixels((index / torch.tensor([SIZE[1], SIZE[0]]))[None], SIZE, image.shape)[0]
    np.testing.assert_allclose(found, spot, atol=0.1)


def test_two_upright_images_are_seen_upright():
    seen = []

    class Network(torch.nn.Module):
        def forward(self, pixel_values):
            seen.append(tuple(pixel_values.shape))
            return answer([[[0.0, 0.0]], [[0.5, 0.5]]], [0], [0.75])

    matcher = LightGlueMatcher(Network(), size=SIZE)
    upright, wide = picture((50, 40)), picture((40, 50))
    a, b, score = matcher.match(upright, upright)
    np.testing.assert_allclose(a, [[0.5 * 40 / 64, 0.5 * 50 / 96]])
    np.testing.assert_allclose(b, [[20 + 0.5 * 40 / 64, 25 + 0.5 * 50 / 96]])
    np.testing.assert_array_equal(score, [0.75])
    matcher.match(upright, wide)
    assert seen == [(1, 2, 3, 96, 64), (1, 2, 3, 64, 96)]


def test_what_only_fills_the_lists_up_is_no_match():
    points = np.full((2, 3, 2), 0.5)
    out = answer(points, [2, 1, 0], [0.9, 0.8, 0.7], mask=[[1, 1, 0], [1, 1, 0]])
    assert matched(out, 0.0)[2].tolist() == pytest.approx([0.8])


def test_what_is_not_finite_is_not_passed_on():
    for points, score in ((np.full((2, 1, 2), np.nan), 0.5), (np.zeros((2, 1, 2)), np.nan)):
        with pytest.raises(FloatingPointError, match="matcher's output is not finite: its weights are damaged"):
            matched(answer(points, [0], [score]), 0.2)


def test_keypoints_of_another_detector_are_refused(folders, tmp_path):
    config = json.loads((folders / "lightglue" / "config.json").read_text())
    config["keypoint_detector_config"] = {"model_type": "disk", "auto_map": {"AutoConfig": "disk.DiskConfig"}}
    (tmp_path / "config.json").write_text(json.dumps(config))
    (tmp_path / "model.safetensors").write_bytes(b"")
    with pytest.raises(WeightsError, match="finds keypoints with 'disk'; give weights that were trained on 'superp"):
        MATCHERS["lightglue"](tmp_path, "cpu")


def test_the_other_matcher_is_named(folders):
    with pytest.raises(WeightsError, match="'superglue'; use it as 'superglue', or give a folder with 'lightglue'"):
        MATCHERS["lightglue"](folders / "superglue", "cpu")
