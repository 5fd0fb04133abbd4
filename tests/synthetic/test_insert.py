"""Solids put into photographs: where they show, what hides them, how they are lit and what they shade."""

import numpy as np
import pytest
import torch

from refield.scene.camera import Camera
from refield.scene.srgb import to_linear, to_srgb
from refield.synthetic.cameras import hemisphere
from refield.synthetic.insert import Shot, inserted, seen_in
from refield.synthetic.looks import Look, blur_of, gain_of, noise_of
from refield.synthetic.placing import box_item
from refield.synthetic.shading import CastShadow, Light
from refield.synthetic.state import Item, State
from refield.synthetic.visibility import silhouette

UP = torch.tensor([0.0, 0, 1], dtype=torch.float64)
SUN = torch.tensor([0.8, 0.0, 0.6], dtype=torch.float64)
LIGHT = Light(UP, SUN, share=0.6, spread=0.1, radiance=torch.full((3,), 0.5))
CAMERA = Camera(96, 80, 90.0, 90.0, 47.0, 41.0, k1=0.08, k2=-0.05, p1=0.002)
POSE = hemisphere(10, (0.0, 0.0, 0.1))[4]


def state_of(*items: Item) -> State:
    return State(items, np.zeros((1, 2, 3), np.float32))


@pytest.fixture(scope="module")
def box():
    return box_item(np.random.default_rng(0), "box", (0.2, 0.15, 0.2), 0.3, (0.0, 0.0, 30.0))


def shot(depth: float = 50.0, **look) -> Shot:
    surface = torch.full((CAMERA.height, CAMERA.width), depth)
    image = torch.full((CAMERA.height, CAMERA.width, 3), 120, dtype=torch.uint8)
    return Shot(image, CAMERA, POSE, surface, surface, Look(torch.ones(3), **({"noise": 0.0, "blur": 0.0} | look)))


def test_a_solid_shows_where_the_lens_puts_it_and_nothing_else_changes(box):
    state = state_of(box)
    before = shot()
    done = inserted(before, state, LIGHT, CastShadow(state, LIGHT))
    shown = silhouette(state, "box", CAMERA, POSE)
    assert torch.equal(done.item == 0, shown) and shown.sum() > 300
    from refield.vision.pixels import dilate

    far = ~torch.from_numpy(dilate(shown.numpy(), 2))
    assert torch.equal(done.image[far], before.image[far])
    assert (done.image[shown] != 120).any(-1).float().mean() > 0.95
    assert torch.equal(before.image, torch.full_like(before.image, 120)), "the photo given stays"


def test_what_is_nearer_hides_it(box):
    state = state_of(box)
    near = shot(0.5)
    done = inserted(near, state, LIGHT, lambda x: torch.ones(len(x)))
    assert (done.item == -1).all() and torch.equal(done.image, near.image)
    half = near.limit.clone()
    half[:, 48:] = 50.0
    item = seen_in(Shot(near.image, CAMERA, POSE, half, half, near.look), state)
    assert torch.equal(item == 0, silhouette(state, "box", CAMERA, POSE) & (half > 1))


def test_an_outline_is_smooth_and_as_blurred_as_the_photo(box):
    white = Item("box", box.solid, np.full_like(box.texture, 1.0), box.world_from_item)
    state, light = state_of(white), LIGHT

    def steepest(blur: float) -> int:
        image = inserted(shot(blur=blur), state, light, lambda x: torch.ones(len(x))).image.int()
        return int((image[:, 1:] - image[:, :-1]).abs().max())

    assert steepest(2.0) < steepest(0.0)


def test_the_grain_is_that_of_the_photo_and_from_the_seed(box):
    state, clear = state_of(box), (lambda x: torch.ones(len(x)))
    plain, grainy, again = (inserted(shot(noise=n), state, LIGHT, clear, seed=3).image for n in (0.0, 0.05, 0.05))
    inside = silhouette(state, "box", CAMERA, POSE)
    assert torch.equal(grainy, again)
    spread = (grainy.float() - plain.float())[inside].std() / 255
    assert spread == pytest.approx(0.05, rel=0.15)


def test_a_white_top_in_the_open_is_as_bright_as_the_light():
    item = box_item(np.random.default_rng(0), "box", (0.2, 0.2, 0.2), 0.3, (0.0, 0.0, 0.0))
    white = Item("box", item.solid, np.ones_like(item.texture), item.world_from_item)
    above = torch.eye(4, dtype=torch.float64)
    above[:3, :3] = torch.diag(torch.tensor([1.0, -1, -1]))
    above[2, 3] = 3.0
    there = Shot(shot().image, CAMERA, above, shot().surface, shot().limit, shot().look)
    done = inserted(there, state_of(white), LIGHT, lambda x: torch.ones(len(x)))
    assert to_linear(done.image[41, 47].numpy().astype(np.float32) / 255) == pytest.approx(0.5, abs=0.01)


def test_the_shadow_falls_away_from_the_sun_and_ends(box):
    shadow = CastShadow(state_of(box), LIGHT, (UP, 0.0, 0.01))
    x = torch.tensor([[-0.35, 0, 0], [0.35, 0, 0], [4.0, 0, 0], [-1.5, 1.5, 0], [0.0, 0, 0.001]])
    behind, before, far, aside, beneath = shadow(x).tolist()
    assert behind < 0.6 < before and far == 1 and aside > 0.95 and beneath < behind
    on = torch.tensor([[-0.4, 0.1, 0.0], [0.3, -0.2, 0.0]], dtype=torch.float64)
    assert torch.allclose(shadow(on), shadow.direct(on), atol=0.06), "the lattice is what rays say"


def test_no_solid_no_shadow():
    assert (CastShadow(state_of(), LIGHT, (UP, 0.0, 0.01))(torch.zeros(3, 3)) == 1).all()
    photo = shot()
    assert torch.equal(inserted(photo, state_of(), LIGHT, lambda x: torch.ones(len(x))).image, photo.image)


def test_noise_and_blur_are_measured():
    rng = np.random.default_rng(0)
    grey = np.full((120, 120), 100.0, np.float32)
    grey[:, 60:] = 180
    import cv2

    for sigma in (0.8, 1.6):
        assert blur_of(cv2.GaussianBlur(grey, (0, 0), sigma)) == pytest.approx(sigma, rel=0.25)
    noisy = cv2.GaussianBlur(grey, (0, 0), 1) + rng.normal(0, 3, grey.shape).astype(np.float32)
    assert noise_of(noisy) == pytest.approx(3, rel=0.15)


def test_exposure_is_measured_in_linear_light():
    shown = torch.rand(30, 30, 3, generator=torch.Generator().manual_seed(0)) * 0.5 + 0.2
    photo = torch.from_numpy(to_srgb(1.3 * to_linear(shown.numpy())))
    known = torch.ones(30, 30, dtype=torch.bool)
    assert gain_of(photo, shown, known) == pytest.approx(torch.full((3,), 1.3), rel=1e-3)
    assert torch.equal(gain_of(photo, shown, ~known), torch.ones(3)), "where nothing is known, nothing is changed"
