import numpy as np
import pytest

from refield.vision.segmenter import GrabCutSegmenter


def scene():
    rng = np.random.default_rng(0)
    image = np.full((80, 80, 3), (120, 130, 90), np.uint8)
    yy, xx = np.mgrid[:80, :80]
    disc = (yy - 40) ** 2 + (xx - 36) ** 2 < 16**2
    image[disc] = (200, 60, 50)
    noisy = image + rng.normal(0, 5, image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8), disc


def iou(a, b):
    return (a & b).sum() / (a | b).sum()


def test_a_disc_is_cut_out_of_a_loose_box():
    image, disc = scene()
    masks, scores = GrabCutSegmenter().masks(image, np.array([[14, 18, 58, 62]]))
    assert masks.shape == (1, 80, 80) and iou(masks[0], disc) > 0.9 and scores[0] > 0.4


def test_a_hint_that_is_too_large_is_trimmed():
    image, disc = scene()
    yy, xx = np.mgrid[:80, :80]
    hint = (yy - 40) ** 2 + (xx - 36) ** 2 < 20**2
    masks, _ = GrabCutSegmenter().masks(image, np.array([[12, 16, 60, 64]]), hint[None])
    assert iou(masks[0], disc) > 0.9


def test_no_boxes_no_masks_and_features_have_the_promised_shape():
    image, _ = scene()
    masks, scores = GrabCutSegmenter().masks(image, np.zeros((0, 4)))
    assert masks.shape == (0, 80, 80) and scores.shape == (0,)
    assert GrabCutSegmenter().features(image).shape == (20, 20, 23)


def test_features_tell_colours_apart_and_little_else():
    def likeness(a, b):
        one, other = (GrabCutSegmenter().features(np.full((8, 8, 3), c, np.uint8))[0, 0] for c in (a, b))
        assert np.linalg.norm(one) == pytest.approx(np.linalg.norm(other), rel=1e-5)
        return float(one @ other / (np.linalg.norm(one) * np.linalg.norm(other)))

    orange = (200, 120, 60)
    assert likeness(orange, orange) == pytest.approx(1, abs=1e-5)
    assert likeness(orange, (204, 121, 66)) > 0.95
    assert likeness(orange, (170, 102, 51)) > 0.75  # in the shade
    assert likeness(orange, (60, 120, 200)) < 0.4


def test_a_mask_that_leaves_its_box_empty_is_not_trusted():
    image, _ = scene()
    boxes = np.array([[19, 23, 53, 57], [2, 2, 78, 78]])
    masks, scores = GrabCutSegmenter().masks(image, boxes)
    assert iou(*masks) > 0.9 and scores[0] > GrabCutSegmenter.sure > scores[1]
