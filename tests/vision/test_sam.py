"""SAM's family with small random weights: what surrounds the networks, and opening them from a folder."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file, save_file

from refield.vision import pixels, weights
from refield.vision.sam import SAM, SAM2, covered, to_image, to_network, to_square
from refield.vision.weights import SEGMENTERS, WeightsError
from tests.conftest import HERE

transformers = pytest.importorskip("transformers")

SIZES = [(48, 64), (64, 48), (90, 61), (33, 100), (9, 7), (64, 64)]
KINDS = ["sam", "sam-hq", "sam2", "sam2-video", "sam3", "sam3-video"]
PROMPTS = {"hidden_size": 8, "mask_input_channels": 4}
DECODER = {"hidden_size": 8, "mlp_dim": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "iou_head_hidden_dim": 8}
MEMORY = {
    "memory_attention_hidden_size": 8,
    "memory_attention_feed_forward_hidden_size": 8,
    "memory_attention_num_attention_heads": 1,
    "memory_attention_num_layers": 1,
    "memory_attention_rope_feat_sizes": [4, 4],
    "memory_encoder_hidden_size": 8,
    "memory_encoder_output_channels": 4,
    "memory_fuser_embed_dim": 8,
    "memory_fuser_intermediate_dim": 8,
    "mask_downsampler_embed_dim": 8,
}


def sam(kind, **decoder):
    vision = {"hidden_size": 16, "output_channels": 8, "num_hidden_layers": 2, "num_attention_heads": 2}
    vision |= {"image_size": 64, "patch_size": 16, "window_size": 2, "global_attn_indexes": [1], "num_pos_feats": 4}
    config = getattr(transformers, f"{kind}Config")(
        vision_config=vision,
        prompt_encoder_config={**PROMPTS, "image_size": 64, "patch_size": 16},
        mask_decoder_config=DECODER | decoder,
    )
    return getattr(transformers, f"{kind}Model")(config)


def sam2(kind, **more):
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=8,
        image_size=[64, 64],
        blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 1, 2, 2],
        window_size_per_stage=[4, 2, 2, 2],
        global_attention_blocks=[3],
        window_positional_embedding_background_size=[2, 2],
    )
    sizes = {"backbone_channel_list": [64, 32, 16, 8], "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]]}
    config = getattr(transformers, f"{kind}Config")(
        vision_config=transformers.Sam2VisionConfig(backbone_config=backbone, fpn_hidden_size=8, **sizes),
        prompt_encoder_config={**PROMPTS, "image_size": 64, "patch_size": 16},
        mask_decoder_config=DECODER,
        **more,
    )
    return getattr(transformers, f"{kind}Model")(config)


def sam3_vision():
    backbone = transformers.Sam3ViTConfig(
        hidden_size=16,
        intermediate_size=16,
        num_hidden_layers=2,
        num_attention_heads=2,
        image_size=56,
        patch_size=14,
        window_size=2,
        global_attn_indexes=[1],
        pretrain_image_size=28,
    )
    sizes = {"backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]], "fpn_hidden_size": 8}
    return transformers.Sam3VisionConfig(backbone_config=backbone, **sizes)


def sam3():
    prompts = {**PROMPTS, "image_size": 56, "patch_size": 14}
    parts = {"prompt_encoder_config": prompts, "mask_decoder_config": DECODER}
    return transformers.Sam3TrackerModel(transformers.Sam3TrackerConfig(vision_config=sam3_vision(), **parts))


def sam3_video():
    """Detector and tracker in one, as SAM 3 is published."""
    prompts = {**PROMPTS, "image_size": 56, "patch_size": 14}
    parts = {"prompt_encoder_config": prompts, "mask_decoder_config": DECODER}
    tracker = transformers.Sam3TrackerVideoConfig(vision_config=sam3_vision(), image_size=56, **parts, **MEMORY)
    layer = {"hidden_size": 8, "num_attention_heads": 2}
    layers = {**layer, "num_layers": 1, "intermediate_size": 8}
    text = {**layer, "num_hidden_layers": 1, "intermediate_size": 8, "vocab_size": 9, "projection_dim": 8}
    detector = transformers.Sam3Config(
        vision_config=sam3_vision(),
        text_config=text,
        geometry_encoder_config=layers,
        detr_encoder_config=layers,
        detr_decoder_config={**layers, "num_queries": 2},
        mask_decoder_config=layer,
    )
    whole = transformers.Sam3VideoConfig(detector_config=detector.to_dict(), tracker_config=tracker.to_dict())
    return transformers.Sam3VideoModel(whole)


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Networks this small are slower on several."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A folder per kind of model, as ``save_pretrained`` writes it."""
    torch.manual_seed(0)
    transformers.utils.logging.disable_progress_bar()
    models = {
        "sam": sam("Sam"),
        "sam-hq": sam("SamHQ", vit_dim=16),
        "sam2": sam2("Sam2"),
        "sam2-video": sam2("Sam2Video", **MEMORY),
        "sam3": sam3(),
        "sam3-video": sam3_video(),
    }
    root = tmp_path_factory.mktemp("weights")
    for name, model in models.items():
        model.save_pretrained(root / name)
    # As published: save_pretrained of transformers 5.23 writes this part of the names twice.
    path = root / "sam3-video" / "model.safetensors"
    tensors = {n.replace("tracker_model." * 2, "tracker_model."): x for n, x in load_file(path).items()}
    save_file(tensors, path, {"format": "pt"})
    transformers.utils.logging.enable_progress_bar()
    return root


@pytest.fixture
def segmenter(folders, request):
    name = getattr(request, "param", "sam")
    return SEGMENTERS[name.removesuffix("-video")](folders / name, "cpu")


def picture(size, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)


def boxes_in(size, count=3):
    rng = np.random.default_rng(2)
    low = rng.uniform(0, 0.4, (count, 2)) * (size[1], size[0])
    return np.concatenate([low, low + rng.uniform(0.2, 0.6, (count, 2)) * (size[1], size[0])], 1)


@pytest.mark.parametrize("segmenter", KINDS, indirect=True)
def test_every_kind_gives_masks_scores_and_features(segmenter):
    for size in [(48, 64), (90, 61), (9, 7)]:
        image = picture(size)
        masks, scores = segmenter.masks(image, boxes_in(size))
        assert masks.shape == (3, *size) and masks.dtype == bool
        assert scores.shape == (3,) and scores.dtype == np.float64 and (scores >= 0).all() and (scores <= 1).all()
        features = segmenter.features(image)
        assert features.dtype == np.float32 and features.shape[2] == 8 and np.isfinite(features).all()
        masks, scores = segmenter.masks(image, np.zeros((0, 4)))
        assert masks.shape == (0, *size) and scores.shape == (0,)


@pytest.mark.parametrize("size", SIZES)
def test_sams_image_boxes_and_masks_are_prepared_as_transformers_does(size):
    side = 64
    reference = transformers.SamImageProcessorPil(size={"longest_edge": side}, pad_size={"height": side, "width": side})
    image, boxes = picture(size), boxes_in(size)
    told = reference(images=Image.fromarray(image), return_tensors="pt")
    torch.testing.assert_close(to_square(image, side, SAM), told["pixel_values"], atol=2e-6, rtol=0)
    placed = SAM.placed(size, side)
    assert placed == tuple(told["reshaped_input_sizes"][0].tolist())
    # The processor hands boxes on with edges at pixel borders though the network counts from pixel centres.
    expected = transformers.SamProcessor(reference)._normalize_coordinates(side, boxes, size, is_bounding_box=True)
    np.testing.assert_allclose(to_network(boxes, size, placed)[0] + 0.5, expected, rtol=1e-5)
    logits = torch.randn(3, 16, 16, generator=torch.Generator().manual_seed(0))
    masks = reference.post_process_masks([logits[:, None]], [size], [placed])[0][:, 0]
    assert torch.equal(to_image(logits, size, placed, side), masks)


@pytest.mark.parametrize("size", SIZES)
def test_sam2_stretches_the_image_over_the_square(size):
    image = picture(size)
    image[:, : size[1] // 2] = (255, 0, 0)
    x = to_square(image, 64, SAM2)[0] * torch.tensor(SAM2.std)[:, None, None] + torch.tensor(SAM2.mean)[:, None, None]
    red = x[:, :, : max(1, int(64 * (size[1] // 2 - 1) / size[1]))]
    torch.testing.assert_close(red, torch.tensor([1.0, 0, 0])[:, None, None].expand_as(red), atol=1e-5, rtol=0)
    assert x.shape == (3, 64, 64) and (x[:, :, 40:].std() > 0.1 or size[0] < 10)


@pytest.mark.parametrize("size", [(60, 90), (91, 60), (40, 40), (300, 200)])
@pytest.mark.parametrize("segmenter", KINDS, indirect=True)
def test_a_box_comes_back_where_it_was(segmenter, size, monkeypatch):
    """The network is replaced by one that draws the box it is given, as the distance to its nearest edge.

    Interpolation keeps that exact along the edges, so that half a pixel too many anywhere would show.
    """
    side, cells = segmenter.side, 16

    def draw(image_embeddings, input_boxes, **_):
        x0, y0, x1, y1 = (input_boxes[0] + 0.5)[:, :, None, None].unbind(1)  # as all these networks do
        at = (torch.arange(cells) + 0.5) * (side / cells)
        x, y = at[None, None, :], at[None, :, None]
        inside = torch.minimum(torch.minimum(x - x0, x1 - x), torch.minimum(y - y0, y1 - y))
        return transformers.utils.ModelOutput(
            pred_masks=inside[None, :, None], iou_scores=torch.tensor([[[1.3]] * len(inside)])
        )

    monkeypatch.setattr(segmenter.model, "forward", draw)
    h, w = size
    boxes = np.array([[0, 0, w, h], [w // 8, h // 7, w - w // 6, h - h // 8], [w // 4, 0, w // 4 + w // 2, h // 2]])
    masks, scores = segmenter.masks(picture(size), boxes)
    for mask, box in zip(masks, boxes):
        assert pixels.bounding_box(mask) == tuple(box)
        x, y = (box[:2] + box[2:]) // 2
        assert mask[y, box[0] : box[2]].all() and mask[box[1] : box[3], x].all()
        assert mask.sum() > 0.9 * np.prod(box[2:] - box[:2])  # corners are rounded by the coarse grid
    assert (scores == 1).all()


def test_boxes_are_cut_to_the_image_and_empty_ones_give_nothing(segmenter):
    image = picture((48, 64))
    boxes = np.array([[-20, 10, 30, 90], [0, 10, 30, 48], [70, 5, 90, 9], [20, 20, 20, 30]], float)
    masks, scores = segmenter.masks(image, boxes)
    np.testing.assert_array_equal(masks[0], masks[1])
    assert scores[0] == scores[1] and not masks[2:].any() and (scores[2:] == 0).all()
    with pytest.raises(ValueError, match="boxes must be finite"):
        segmenter.masks(image, np.array([[0, 0, np.nan, 4]]))


def test_nothing_outside_the_hint_is_in(segmenter):
    image, boxes = picture((48, 64)), boxes_in((48, 64))
    hint = np.random.default_rng(3).random((3, 48, 64)) > 0.5
    free, free_scores = segmenter.masks(image, boxes)
    held, held_scores = segmenter.masks(image, boxes, hint)
    assert free.any()
    np.testing.assert_array_equal(held, free & hint)
    np.testing.assert_array_equal(held_scores, free_scores)


def test_batches_do_not_change_the_result(segmenter):
    image, boxes = picture((48, 64)), boxes_in((48, 64), 5)
    together, scores = segmenter.masks(image, boxes)
    segmenter.batch = 2
    apart, apart_scores = segmenter.masks(image, boxes)
    assert (together != apart).mean() < 1e-3
    np.testing.assert_allclose(scores, apart_scores, atol=1e-5)


@pytest.mark.parametrize("segmenter", ["sam", "sam-hq", "sam2"], indirect=True)
def test_an_image_is_embedded_once_while_it_is_remembered(segmenter, monkeypatch):
    embed, calls = segmenter.model.get_image_embeddings, []

    def counted(x):
        calls.append(x)
        return embed(x)

    monkeypatch.setattr(segmenter.model, "get_image_embeddings", counted)
    first, boxes = picture((48, 64)), boxes_in((48, 64))
    before = segmenter.masks(first, boxes)[0]
    segmenter.features(first.copy())
    np.testing.assert_array_equal(segmenter.masks(first.copy(), boxes)[0], before)
    assert len(calls) == 1
    segmenter.features(first.reshape(64, 48, 3))  # the same bytes, another image
    assert len(calls) == 2
    segmenter.remembered = 2
    segmenter.features(first)
    segmenter.features(picture((48, 64), seed=9))
    segmenter.features(first)
    assert len(calls) == 3 and len(segmenter._embeddings) == 2
    segmenter.features(first.reshape(64, 48, 3))
    assert len(calls) == 4


@pytest.mark.parametrize("size", SIZES)
def test_features_lie_evenly_over_the_image(size):
    side, cells = 64, 16
    placed = SAM.placed(size, side)
    at = (torch.arange(cells) + 0.5) * (side / cells)
    embedding = torch.stack([at[None, :].expand(cells, -1), at[:, None].expand(-1, cells)])[None]
    x, y = covered(embedding, placed, side)[0]
    assert x.shape == tuple(max(1, cells * p // side) for p in placed)
    torch.testing.assert_close(x[0], (torch.arange(x.shape[1]) + 0.5) * placed[1] / x.shape[1], atol=1e-3, rtol=0)
    torch.testing.assert_close(y[:, 0], (torch.arange(y.shape[0]) + 0.5) * placed[0] / y.shape[0], atol=1e-3, rtol=0)


def test_features_of_whole_cells_are_the_embeddings_own(segmenter):
    image = picture((48, 64))
    with torch.inference_mode():
        embedding = segmenter.model.get_image_embeddings(to_square(image, 64, SAM))
    assert segmenter.features(image).shape == (3, 4, 8)
    np.testing.assert_allclose(segmenter.features(image), embedding[0, :, :3].permute(1, 2, 0), atol=1e-5)


def test_what_is_not_finite_is_not_passed_on(segmenter):
    with torch.no_grad():
        segmenter.model.vision_encoder.neck.conv1.weight[0] = torch.nan
    for call in (segmenter.features, lambda image: segmenter.masks(image, boxes_in((48, 64)))):
        with pytest.raises(FloatingPointError, match="not finite: its weights are damaged"):
            call(picture((48, 64)))


# Opening


def test_sam3s_tracker_is_taken_out_of_the_whole(folders):
    whole = load_file(folders / "sam3-video" / "model.safetensors")
    tracker = weights.open_model(folders / "sam3-video", weights.CLASSES["sam3"]).state_dict()
    places = {
        "vision_encoder.backbone.": "detector_model.vision_encoder.backbone.",
        "vision_encoder.neck.": "tracker_neck.",
    }
    for name, value in tracker.items():
        start = next((p for p in places if name.startswith(p)), "")
        assert torch.equal(value, whole[places.get(start, "tracker_model.") + name.removeprefix(start)]), name


@pytest.fixture
def spoilt(folders, tmp_path):
    """A copy of SAM's folder, to be spoilt."""
    for path in (folders / "sam").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def edit(folder, **values):
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | values))


def without_one_tensor(folder):
    tensors = load_file(folder / "model.safetensors")
    del tensors["mask_decoder.iou_token.weight"]
    save_file(tensors, folder / "model.safetensors", {"format": "pt"})


def with_nan(folder):
    tensors = load_file(folder / "model.safetensors")
    tensors["mask_decoder.iou_token.weight"][0, 0] = torch.nan
    save_file(tensors, folder / "model.safetensors", {"format": "pt"})


def with_another_decoder(folder):
    config = json.loads((folder / "config.json").read_text())
    edit(folder, mask_decoder_config=config["mask_decoder_config"] | {"mlp_dim": 24})


SPOILT = {
    "no config.json; get it from where the weights came from": lambda f: (f / "config.json").unlink(),
    "config.json is not JSON (.*); get the file again": lambda f: (f / "config.json").write_text("{"),
    "config.json has the model_type 'None'; give a folder with 'sam'": lambda f: (f / "config.json").write_text("[]"),
    "config.json has the model_type 'bert'; give a folder with 'sam'": lambda f: edit(f, model_type="bert"),
    "model_type 'sam2_video'; use it as 'sam2', or give a folder with 'sam'": lambda f: edit(
        f, model_type="sam2_video"
    ),
    "asks for code from outside (auto_map); give a folder without it": lambda f: edit(f, auto_map={"AutoModel": "x.y"}),
    "has no *.safetensors; get the weights in that format": lambda f: (f / "model.safetensors").rename(f / "x.bin"),
    "cannot be opened (.*); get config.json and *.safetensors again, together": lambda f: (
        f / "model.safetensors"
    ).write_bytes(b"nothing"),
    "cannot be opened (.*); get config.json": with_another_decoder,
    "1 weights are missing, such as mask_decoder.iou_token.weight; get config.json": without_one_tensor,
    "1 weights are not finite, such as mask_decoder.iou_token.weight; get config.json": with_nan,
}


@pytest.mark.parametrize(("message", "spoil"), SPOILT.items(), ids=range(len(SPOILT)))
def test_weights_that_cannot_be_used_are_refused_in_one_line(spoilt, message, spoil):
    spoil(spoilt)
    with pytest.raises(WeightsError) as caught:
        SEGMENTERS["sam"](spoilt, "cpu")
    assert re.search(re.escape(message).replace(r"\.\*\)", r".*\)"), str(caught.value)), caught.value
    assert str(caught.value).startswith(f"{spoilt}: ") and "\n" not in str(caught.value)


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(WeightsError, match=r"nowhere: is not a folder; give the folder that holds config.json"):
        SEGMENTERS["sam2"](tmp_path / "nowhere", "cpu")


def test_without_transformers_the_message_says_what_to_install(spoilt, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(WeightsError, match=r"needs transformers; pip install 'refield\[sam\]'"):
        SEGMENTERS["sam"](spoilt, "cpu")


def test_a_transformers_that_lacks_the_class(spoilt):
    with pytest.raises(WeightsError, match=r"transformers installed here has no working Sam9Model .*; pip install -U"):
        weights.open_model(spoilt, {"sam": "Sam9Model"})


def test_opening_leaves_transformers_logging_as_it_was(folders):
    logging = transformers.utils.logging
    before = logging.get_verbosity(), logging.is_progress_bar_enabled()
    weights.open_model(folders / "sam", weights.CLASSES["sam"])
    assert (logging.get_verbosity(), logging.is_progress_bar_enabled()) == before


def test_names_are_known_without_transformers():
    code = "import sys, refield.vision.weights; sys.exit('transformers' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], env=HERE, check=False).returncode == 0
