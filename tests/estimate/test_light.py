"""Light that changed on what did not: told by a surface's own detail, in one photo alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from refield.estimate.detect import Changed, DetectConfig
from refield.estimate.light import Ratio, light_of_others, same_detail, set_light_aside
from refield.estimate.look import View
from refield.scene.camera import Camera
from refield.scene.srgb import to_linear, to_srgb
from refield.vision import pixels

CONFIG = DetectConfig()
SIDE = 120
SHADE = np.s_[20:80, 20:90]
EVERYWHERE = np.ones((SIDE, SIDE), bool)


def pattern(seed: int, sigma: float = 2.0) -> np.ndarray:
    """(SIDE, SIDE, 3) blotches."""
    noise = np.random.default_rng(seed).normal(size=(SIDE, SIDE, 3)).astype(np.float32)
    blotches = pixels.blur(noise, sigma)
    return np.clip(0.45 + 0.1 * blotches / blotches.std(), 0.05, 0.95)


def view_of(photo: np.ndarray, field: np.ndarray) -> View:
    """A photo beside what the field shows, one metre away all over."""
    one = np.ones((SIDE, SIDE), np.float32)
    camera = Camera(SIDE, SIDE, 100.0, 100.0, SIDE / 2, SIDE / 2)
    frame = type("F", (), {"world_from_cam": torch.eye(4, dtype=torch.float64), "camera": camera, "name": "x"})()
    return View(frame, camera, photo.astype(np.float32), field.astype(np.float32), one, one)


def marked(view: View, where: tuple[slice, slice]) -> Changed:
    mask = np.zeros(view.shape, bool)
    mask[where] = True
    some, none = np.ones(view.shape, np.float32), np.zeros(view.shape, bool)
    return Changed(view, 20 * mask, some, mask, none, none)


def shaded(field: np.ndarray, gain: tuple[float, float, float]) -> np.ndarray:
    """A soft shadow, or a brighter light, within SHADE."""
    weight = np.zeros((SIDE, SIDE), np.float32)
    weight[SHADE] = 1
    weight = pixels.blur(weight, 4)[..., None]
    return to_srgb(to_linear(field) * (1 + weight * (np.array(gain, np.float32) - 1)))


@pytest.mark.parametrize("gain", [(0.5, 0.5, 0.5), (0.5, 0.55, 0.62), (1.6, 1.6, 1.6)])
def test_one_photos_shadow_on_a_known_surface_is_light(gain):
    field = pattern(0)
    (told,) = set_light_aside([marked(view_of(shaded(field, gain), field), SHADE)], [], CONFIG)
    assert told.mask.mean() < 0.05 * np.mean(marked(told.view, SHADE).mask)
    assert told.light[SHADE].mean() > 0.95


def test_another_surface_is_no_light():
    field, photo = pattern(0), pattern(0)
    photo[SHADE] = 0.7 * pattern(1)[SHADE]  # as dark as a shadow makes it
    (told,) = set_light_aside([marked(view_of(photo, field), SHADE)], [], CONFIG)
    assert told.mask[SHADE].mean() > 0.9


def test_a_plain_thing_before_a_patterned_wall_is_no_light():
    field, photo = pattern(0), pattern(0)
    photo[SHADE] = 0.25
    (told,) = set_light_aside([marked(view_of(photo, field), SHADE)], [], CONFIG)
    assert told.mask[SHADE].mean() > 0.9


def test_a_small_thing_that_left_is_no_light_before_a_wall_that_stayed():
    """Around it there is more of the wall than there is of itself."""
    field, photo = pattern(0), pattern(0)
    small = np.s_[50:57, 50:57]
    field[small], photo[small] = 0.9 * pattern(4)[small][..., :1], 0.4  # grey and patterned, before a plain patch
    assert same_detail(view_of(photo, field), EVERYWHERE, CONFIG)[small].mean() > 0.9
    (told,) = set_light_aside([marked(view_of(photo, field), small)], [], CONFIG)
    assert told.mask[small].mean() > 0.9


def test_a_plain_wall_tells_nothing():
    field = np.full((SIDE, SIDE, 3), 0.6, np.float32)
    assert not same_detail(view_of(0.8 * field, field), EVERYWHERE, CONFIG).any()


def test_detail_is_known_however_bright():
    field = pattern(3)
    assert same_detail(view_of(to_srgb(0.3 * to_linear(field)), field), EVERYWHERE, CONFIG).mean() > 0.95
    assert same_detail(view_of(pattern(4), field), EVERYWHERE, CONFIG).mean() < 0.05
    assert not same_detail(view_of(1 - field, field), EVERYWHERE, CONFIG).any()  # a negative is no light


def test_dark_channels_have_no_tint():
    """A brown floor has next to no blue: half its light is half of that as well, though the ratio is drawn to none."""
    field = pattern(5) * np.array([0.7, 0.4, 0.12], np.float32)
    ratio = Ratio.of(view_of(to_srgb(0.5 * to_linear(field)), field), field, CONFIG)
    np.testing.assert_allclose(ratio.tint, 0, atol=0.03)
    assert float(ratio.each[..., 2].mean()) > float(ratio.each[..., 0].mean()) + 0.1
    assert ratio.even_and_grey.mean() > 0.95


def test_another_paint_is_a_tint():
    field = pattern(6)
    ratio = Ratio.of(view_of(field[..., ::-1] * np.array([0.5, 1, 1], np.float32), field), field, CONFIG)
    assert ratio.even_and_grey.mean() < 0.1


@pytest.mark.parametrize("hidden", [False, True])
def test_light_of_others_is_that_on_the_same_surface(hidden):
    """Three cameras side by side before a wall: a shadow on it is in all of them, what stands before it is not."""
    field, views = pattern(6), []
    for k in range(3):
        view = view_of(field, field)
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = 0.2 * k  # 20 pixels on the wall
        frame = type("F", (), {"world_from_cam": pose, "camera": view.camera, "name": "x"})()
        away = (1 / view.directions[..., 2]).astype(np.float32)
        dark = np.ones(view.shape, np.float32)
        dark[40:80, 50 - 20 * k : 90 - 20 * k] = 0.5
        photo = to_srgb(to_linear(field) * dark[..., None]).astype(np.float32)
        views.append(replace(view, frame=frame, photo=photo, depth=away))
    covered = [np.full(v.shape, hidden) for v in views]
    ratios = [Ratio.of(v, v.rgb, CONFIG) for v in views]
    for k, told in enumerate(light_of_others(views, ratios, covered)):
        if hidden:
            assert np.isnan(told).all()
            continue
        np.testing.assert_allclose(told[45:75, 55 - 20 * k : 85 - 20 * k], np.log(0.5), atol=0.1)  # drawn towards none
        np.testing.assert_allclose(told[5:30, 40:80], 0, atol=1e-3)
    assert np.isnan(light_of_others(views[:1], ratios[:1], covered[:1])[0]).all()
