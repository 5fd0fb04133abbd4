"""DINOv2's descriptors with random weights: handed over rightly, opened from a folder; VLAD finds the same place."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from refield.vision.vlad import learn_words, vlad
from refield.vision.weights import DESCRIBERS, WeightsError

transformers = pytest.importorskip("transformers", reason="the extra 'sam' is not installed")


@pytest.mark.parametrize("registers", [False, True])
def test_dinov2_from_a_folder(tmp_path, registers):
    kind = ("Dinov2WithRegisters" if registers else "Dinov2") + "{}"
    sizes = {"hidden_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2, "image_size": 28, "patch_size": 14}
    config = getattr(transformers, kind.format("Config"))(**sizes)
    getattr(transformers, kind.format("Model"))(config).save_pretrained(tmp_path)
    describer = DESCRIBERS["dinov2"](tmp_path, "cpu")
    image = np.random.default_rng(0).integers(0, 255, (90, 60, 3), np.uint8)
    vector = describer.describe(image)
    assert vector.shape == (48,) and float(vector.norm()) == pytest.approx(1, abs=1e-5)
    assert torch.equal(vector, describer.describe(image)), "the same picture, the same vector"
    assert float(vector @ describer.describe(image[:, ::-1].copy())) < 0.99999


def test_another_model_is_told(tmp_path):
    (tmp_path / "config.json").write_text('{"model_type": "sam"}')
    with pytest.raises(WeightsError, match="use it as 'sam', or give a folder with 'dinov2'"):
        DESCRIBERS["dinov2"](tmp_path, "cpu")


def test_vlad_tells_places_apart():
    random = torch.Generator().manual_seed(0)
    places = [torch.nn.functional.normalize(torch.randn(200, 32, generator=random), dim=1) for _ in range(4)]
    again = [torch.nn.functional.normalize(p + 0.1 * torch.randn(200, 32, generator=random), dim=1) for p in places]
    words = learn_words(places, 8)
    first, second = (torch.stack([vlad(p, words) for p in group]) for group in (places, again))
    assert (second @ first.T).argmax(1).tolist() == [0, 1, 2, 3]
    assert torch.equal(vlad(torch.zeros(0, 32), words), torch.zeros(8 * 32))
