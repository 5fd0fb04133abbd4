"""Which segmenter and matcher are used, and what is said when one cannot be."""

from pathlib import Path

import pytest

from refield.estimate.models import ModelConfig
from refield.scene.errors import InputError
from refield.vision.matcher import SiftMatcher
from refield.vision.segmenter import GrabCutSegmenter


def test_the_default_needs_no_weights():
    models = ModelConfig().open()
    assert isinstance(models.segmenter, GrabCutSegmenter) and isinstance(models.matcher, SiftMatcher)


@pytest.mark.parametrize(("kind", "name"), [("segmenter", "sam"), ("matcher", "lightglue")])
def test_a_model_without_its_weights_names_the_option(kind, name):
    with pytest.raises(InputError, match=f"--estimate.models.{kind}-weights FOLDER"):
        ModelConfig(**{kind: name}).open()


@pytest.mark.parametrize(("kind", "name"), [("segmenter", "sam2"), ("matcher", "superglue")])
def test_weights_that_cannot_be_used_name_the_folder(kind, name, tmp_path):
    with pytest.raises(InputError, match=r"config\.json") as caught:
        ModelConfig(**{kind: name, f"{kind}_weights": Path(tmp_path)}).open()
    assert str(tmp_path) in str(caught.value)
