"""The paper's pose step on features that are few, noisy and often wrong; contours that hold two masks."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from refield.estimate.paper import settle
from refield.estimate.paper.config import PaperConfig
from refield.estimate.paper.detect import holds_two
from refield.estimate.paper.pose import MatchedPose, Matches, PoseConfig, matched_pose, softened, world_from_object
from refield.estimate.paper.refine import Refined
from refield.scene.capture import Frame
from refield.scene.pose import angle_between, exp, invert, transform
from refield.synthetic.cameras import looking_at, square_camera

CAMERA = square_camera(512)
MOVED = exp(torch.tensor([0.22, 0.23, 0.01, 0.05, -0.03, 0.6], dtype=torch.float64))
SIDE = 0.2


def photo(azimuth):
    a = math.radians(azimuth)
    where = torch.tensor([2 * math.cos(a), 2 * math.sin(a), 1.4], dtype=torch.float64)
    return SimpleNamespace(
        frame=Frame(None, CAMERA, f"{azimuth}", looking_at(where, torch.zeros(3).double())), camera=CAMERA
    )


def features(view, axis, rng, wrong=3, count=6):
    """Of one side of a cube, found to a pixel or so; some of them somewhere else on it."""
    xyz = rng.uniform(-SIDE, SIDE, (count + wrong, 3))
    xyz[:, axis] = SIDE
    there = transform(invert(view.frame.world_from_cam) @ MOVED, torch.from_numpy(xyz))
    uv = CAMERA.project(there)[0].numpy() + rng.normal(0, 0.7, (len(xyz), 2))
    uv[count:] += rng.uniform(20, 60, (wrong, 2))
    return Matches(view, view, uv, xyz)


def off(pose):
    return float(angle_between(pose, MOVED)), float((pose - MOVED)[:3, 3].norm())


@pytest.mark.parametrize("seed", range(3))
def test_the_features_of_all_pairs_fix_a_pose_that_those_of_one_leave_open(seed):
    rng = np.random.default_rng(seed)
    views = [photo(a) for a in (20, 110, 200, 290)]
    pairs = [features(v, axis, rng) for v, axis in zip(views, (0, 1, 2, 2))]
    config = PoseConfig(least=6)
    turn, shift = off(world_from_object(pairs, config))
    assert turn < 0.9 and shift < 0.003  # degrees, metres
    alone = [off(p) for m in pairs if (p := world_from_object([m], config)) is not None]
    assert alone and max(t for t, _ in alone) > 2 * turn and max(s for _, s in alone) > 4 * shift


def test_what_agrees_on_nothing_has_no_pose():
    rng = np.random.default_rng(0)
    views = [photo(a) for a in (20, 140, 260)]
    pairs = [Matches(v, v, rng.uniform(150, 350, (9, 2)), rng.uniform(-SIDE, SIDE, (9, 3))) for v in views]
    found = world_from_object(pairs, PoseConfig())
    thing = SimpleNamespace(sightings=())
    assert matched_pose(thing, thing, None, PoseConfig()) is None  # nothing was matched
    assert world_from_object(pairs[:1], PoseConfig(least=10)) is None
    uv = np.concatenate([m.uv for m in pairs])
    agree = 0
    if found is not None:
        seen = [
            CAMERA.project(transform(invert(m.came.frame.world_from_cam) @ found, torch.from_numpy(m.xyz)))[0]
            for m in pairs
        ]
        agree = int((np.linalg.norm(np.concatenate(seen) - uv, axis=1) < PoseConfig.error).sum())
    assert agree < PoseConfig.least


def test_refinement_that_leads_away_from_the_features_is_not_taken(monkeypatch):
    rng = np.random.default_rng(1)
    pairs = tuple(features(photo(a), axis, rng, wrong=0) for a, axis in ((20, 0), (110, 1), (200, 2)))
    start = world_from_object(pairs, PoseConfig())
    found = MatchedPose(start, 18, 1.0, pairs)
    nowhere = torch.eye(4, dtype=torch.float64)
    nowhere[0, 3] = 5
    for end, taken in ((MOVED, MOVED), (nowhere, start)):
        monkeypatch.setattr(settle, "matched_pixels", lambda matches: [])
        monkeypatch.setattr(settle, "refine", lambda field, targets, begin, config, end=end: Refined(end, 0.1, 0.3, 7))
        better = settle.refined_pose(None, found, SimpleNamespace(sightings=()), PaperConfig())
        assert torch.equal(better.new_from_old, taken)
        assert better.loss == (0.1 if taken is MOVED else 0.3)


def test_a_photo_is_softened_by_a_share_of_its_width():
    dot = np.zeros((101, 400, 3), np.uint8)
    dot[50, 200] = 255
    assert softened(dot, 0.0) is dot
    across = softened(dot, 0.01)[50, :, 0].astype(float)  # a sigma of 4 pixels
    where = np.arange(400)
    assert math.sqrt((across * (where - 200) ** 2).sum() / across.sum()) == pytest.approx(4, rel=0.15)


def block(x0, x1):
    mask = np.zeros((20, 100), bool)
    mask[:, x0:x1] = True
    return mask


@pytest.mark.parametrize(
    ("came", "left", "two"),
    [
        (block(10, 60), block(40, 90), True),
        (block(10, 90), block(0, 0), False),  # an object came: the rendering shows none there
        (block(10, 90), block(20, 50), False),  # what the segmenter saw of the ground lies within it
        (block(12, 90), block(5, 95), False),  # or around it
        (block(10, 50), block(86, 99), False),  # the second is elsewhere
    ],
)
def test_a_contour_holds_two_where_each_picture_shows_another_part_of_it(came, left, two):
    assert holds_two(block(10, 90), came, left, 0.1) == two == holds_two(block(10, 90), left, came, 0.1)
