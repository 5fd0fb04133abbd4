"""The paper's route: its constants on made-up inputs; the whole of it with exact stand-ins, and without weights."""

import math
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from refield.estimate.look import View, spread_out, view_of
from refield.estimate.models import Models
from refield.estimate.paper.align import AlignConfig, found_warp, unwarped, warped
from refield.estimate.paper.associate import Sighting, associate
from refield.estimate.paper.config import PaperConfig
from refield.estimate.paper.detect import (
    Contour,
    DetectConfig,
    Pair,
    ViewMasks,
    blurred,
    contours,
    detect,
    enlarged,
    floor_of,
    overlapping,
)
from refield.estimate.paper.pose import PoseConfig, on_object
from refield.estimate.paper.refine import RefineConfig, Targets, moved_colours, refine, turned_and_shifted
from refield.estimate.paper.route import estimate_change_paper
from refield.estimate.paper.segment import OldMask, SegmentConfig, object_cloud, old_masks, projection_check
from refield.field.render import render_camera
from refield.scene.capture import Capture, Frame, camera_rays
from refield.scene.errors import InputError
from refield.scene.images import frame_image, write_image
from refield.scene.pose import angle_between, exp, invert, transform
from refield.synthetic.cameras import hemisphere, looking_at, square_camera
from refield.synthetic.oracles import AnalyticField, KnownView, OracleMatcher, OracleSegmenter
from refield.synthetic.visibility import silhouette, view_hits
from refield.synthetic.worlds import WORLDS
from refield.vision.pixels import to_bytes
from tests.fields import small_field

SIZE, OLD = 80, 26
CAMERA = square_camera(SIZE)
TARGET = (0.0, 0.0, 0.15)
NEW = [(30, 55), (120, 55), (210, 55), (330, 55)]
"""azimuth and elevation, degrees, from which old and new places lie apart in the picture"""
ACROSS = (60, 45)
"""from where the new place hides part of the old one"""
UNSURE = 5
"""the old photo on which the segmenter is made to hesitate"""
CONFIG = PaperConfig(survey=3, pose=PoseConfig(crop=0), refine=RefineConfig(rays=300, steps=70, patience=40))


# --- a world, its photos, and eyes that know them ---


def camera_at(azimuth, elevation, radius=2.2):
    a, e = math.radians(azimuth), math.radians(elevation)
    way = torch.tensor([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)], dtype=torch.float64)
    middle = torch.tensor(TARGET, dtype=torch.float64)
    return looking_at(middle + radius * way, middle)


def painted(state, analytic, pose):
    """A picture of a state: its colours at the first hits, which is quick."""
    hits, rays = view_hits(state, CAMERA, pose), camera_rays(CAMERA, pose)
    there = hits.item.reshape(-1) >= 0
    depth = torch.where(there, hits.depth.reshape(-1), 0.0)
    rgb = analytic(rays.origins + rays.directions * depth[:, None], rays.directions)[1]
    return torch.where(there[:, None], rgb, 0.0).reshape(SIZE, SIZE, 3)


def taken(folder, pictures, poses):
    folder.mkdir()
    frames = []
    for i, (picture, pose) in enumerate(zip(pictures, poses)):
        write_image(folder / f"{i:03d}.png", picture.clamp(0, 1))
        frames.append(Frame(folder / f"{i:03d}.png", CAMERA, f"{folder.name}/{i:03d}.png", pose))
    return frames


def known(frames, state):
    return [KnownView(frame_image(f).numpy(), state, CAMERA, f.world_from_cam) for f in frames]


def signature(image):
    """What is left of a picture (H, W, 3) when it is so small that a blur does not count."""
    return cv2.resize(np.asarray(image), (12, 12), interpolation=cv2.INTER_AREA).astype(np.float32)


@dataclass
class Eyes:
    """Segmenter and matcher: the oracles', of the known view that looks like the picture given, or like a part of it.

    The oracles know a picture by its very bytes; the route blurs pictures, and crops them.
    """

    views: list
    unsure: set = field(default_factory=set)
    """indices of views in which the segmenter hesitates"""
    sure: float = 0.95

    def __post_init__(self):
        self.signatures = np.stack([signature(v.image) for v in self.views])
        self.segmenter, self.matcher = OracleSegmenter(self.views), OracleMatcher(self.views, every=1)
        self.names = sorted({i.name for v in self.views for i in v.state.items})

    def features(self, image):
        """One channel a name, so that before and after have the same ones."""
        view = self.views[self._find(image)]
        names = [i.name for i in view.state.items]
        hits = view.hits.item.numpy()
        channels = [hits == names.index(n) if n in names else np.zeros(hits.shape, bool) for n in self.names]
        return np.stack([*channels, hits < 0], -1).astype(np.float32)

    def masks(self, image, boxes, hint=None):
        """The oracle's, with a confidence as SAM's is: above 0.95 for what fits the box somehow."""
        index = self._find(image)
        masks, fit = self.segmenter.masks(self.views[index].image, boxes, hint)
        return masks, np.where(fit > 0.3, 0.95, 0.4) + 0.05 * fit - 0.3 * (index in self.unsure)

    def match(self, a, b):
        """The oracle's, between the parts given."""
        (i, corner_a), (j, corner_b) = self._place(a), self._place(b)
        uv_a, uv_b, score = self.matcher.match(self.views[i].image, self.views[j].image)
        uv_a, uv_b = uv_a - corner_a, uv_b - corner_b
        kept = ((uv_a >= 0) & (uv_a < a.shape[1::-1]) & (uv_b >= 0) & (uv_b < b.shape[1::-1])).all(-1)
        return uv_a[kept], uv_b[kept], score[kept]

    def _find(self, image):
        apart = np.abs(self.signatures - signature(image)).mean((1, 2, 3))
        assert apart.min() < 6, "an unknown picture"
        return int(apart.argmin())

    def _place(self, part):
        found = []
        for i, v in enumerate(self.views):
            low, _, at, _ = cv2.minMaxLoc(cv2.matchTemplate(v.image, part, cv2.TM_SQDIFF))
            found.append((low / part.size, i, at))
        error, i, at = min(found)
        assert error < 4, "an unknown part"
        return i, np.array(at, float)


@dataclass
class Stage:
    before: object
    field: AnalyticField
    capture: Capture
    folder: object

    def visit(self, name, items, where=NEW):
        """Photos of a state with these items, in the field's own colours, and eyes that know every picture."""
        after, poses = replace(self.before, items=items), [camera_at(*w) for w in where]
        shown = AnalyticField(after, resolution=96)
        frames = taken(self.folder / name, [render_camera(shown, CAMERA, p).rgb for p in poses], poses)
        views = [view_of(self.field, f, SIZE**2) for f in frames]
        renders = [KnownView(to_bytes(v.rgb), self.before, CAMERA, v.frame.world_from_cam) for v in views]
        eyes = Eyes(known(self.capture.frames, self.before) + known(frames, after) + renders)
        return SimpleNamespace(frames=frames, eyes=eyes, views=views, after=after, shown=shown)

    def estimate(self, visit, config=CONFIG):
        models = Models(visit.eyes, visit.eyes)
        return estimate_change_paper(self.capture, self.field, visit.frames, models, config)


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stage")
    before = WORLDS["removed"](0).before
    analytic = AnalyticField(before, resolution=96)
    poses = hemisphere(OLD, TARGET)
    frames = taken(folder / "before", [painted(before, analytic, p) for p in poses], poses)
    return Stage(before, analytic, Capture(tuple(frames), held_out_every=0), folder)


@pytest.fixture(scope="module")
def moved(stage):
    """The cube moved and turned; the drum left."""
    floor, cube, _ = stage.before.items
    now = cube.turned(-40, (0.85, -0.05, 0))
    visit = stage.visit("moved", (floor, now), [*NEW, ACROSS])
    visit.cube, visit.true = cube, now.world_from_item @ invert(cube.world_from_item)
    return visit


@pytest.fixture(scope="module")
def found(stage, moved):
    """What the route says of it; the segmenter hesitates on one old photo."""
    eyes = replace(moved.eyes, unsure={UNSURE})
    frames = moved.frames[: len(NEW)]
    return estimate_change_paper(stage.capture, stage.field, frames, Models(eyes, eyes), CONFIG)


def off(visit, new_from_old):
    """Degrees, and metres at the cube's centre."""
    c = visit.cube.world_from_item[:3, 3]
    shift = float((transform(new_from_old, c) - transform(visit.true, c)).norm())
    return float(angle_between(new_from_old, visit.true)), shift


def overlap(grid, item):
    """IoU of a grid and an item's true one."""
    low, high = item.box().float()
    x = low - 0.1 + (high - low + 0.2) * torch.rand(100_000, 3, generator=torch.Generator().manual_seed(0))
    a, b = grid.contains(x), item.grid().contains(x)
    return float((a & b).sum() / (a | b).sum())


# --- the whole route, with exact stand-ins ---


def test_what_moved_and_what_left_are_found(found, moved, stage):
    cube, drum = found.objects
    assert (cube.kind, drum.kind) == ("moved", "removed")
    degrees, metres = off(moved, cube.new_from_old)
    assert degrees < 0.5 and metres < 0.002
    assert overlap(cube.grid, stage.before.items[1]) > 0.8  # masks of 80 pixels, and 33 nodes across the object
    assert overlap(drum.grid, stage.before.items[2]) > 0.85
    assert cube.grid.values.shape == (100, 100, 100)
    assert "1 moved by 0.8" in found.why and "turned by 40 degrees" in found.why and "1 removed" in found.why
    assert 0.8 < cube.confidence < 1 and 0.8 < drum.confidence < 1


def test_the_masks_are_the_objects(found, moved, stage):
    for change, name in zip(found.objects, ("cube", "drum")):
        for i, (frame, mask) in enumerate(zip(stage.capture.train, change.masks)):
            if i == UNSURE:  # §10.1.3
                assert mask is None
            else:
                assert torch.equal(mask, silhouette(stage.before, name, CAMERA, frame.world_from_cam))
        assert f"1 of {OLD} old photos" in change.note
    now = [silhouette(moved.after, "cube", CAMERA, f.world_from_cam) for f in stage.capture.train]
    ratios = [float((a & b).sum() / (a | b).sum()) for a, b in zip(found.objects[0].masks_in, now)]
    assert min(ratios) > 0.6 and np.mean(ratios) > 0.8
    for k, frame in enumerate(found.frames):
        was = [silhouette(stage.before, n, CAMERA, frame.world_from_cam) for n in ("cube", "drum")]
        assert torch.equal(found.masks_in[k], silhouette(moved.after, "cube", CAMERA, frame.world_from_cam))
        assert torch.equal(found.masks_out[k], was[0] | was[1])


def test_a_view_in_which_old_and_new_place_overlap_gives_both_masks(stage, moved):
    """Fig. 13: there the other views' number of masks tells that one contour holds two."""
    survey = [view_of(stage.field, f, SIZE**2) for f in spread_out(stage.capture.frames, 2)]
    seen = detect(moved.views, survey, moved.eyes, DetectConfig())
    assert [v.overlap for v in seen] == [False] * len(NEW) + [True]
    for v in seen:
        pose = v.pair.view.frame.world_from_cam
        (came,) = v.move_in
        assert np.array_equal(came, silhouette(moved.after, "cube", CAMERA, pose))
        gone = [silhouette(stage.before, n, CAMERA, pose).numpy() for n in ("cube", "drum")]
        assert {m.tobytes() for m in v.move_out} == {m.tobytes() for m in gone}
    # alone, the merged contour still holds two masks; were it not asked for that, it would lose one of them
    (alone,) = detect(moved.views[-1:], survey, moved.eyes, DetectConfig())
    assert alone.overlap and len(alone.move_in) + len(alone.move_out) == 3
    (one,) = detect(moved.views[-1:], survey, moved.eyes, DetectConfig(own=1.01))
    assert not one.overlap and len(one.move_in) + len(one.move_out) == 2


def test_one_new_photo_is_told_to_be_too_few(stage, moved):
    change = estimate_change_paper(
        stage.capture, stage.field, moved.frames[:1], Models(moved.eyes, moved.eyes), replace(CONFIG, survey=1)
    )
    assert change.objects == () and change.masks_in == () and "one side only of where it was" in change.why


def test_an_added_object_is_carved_from_its_masks(stage):
    floor, cube, drum = stage.before.items
    guest = replace(cube.turned(-40, (0.85, -0.05, 0)), name="guest")
    visit = stage.visit("added", (floor, cube, drum, guest))
    (change,) = stage.estimate(visit).objects
    assert change.kind == "added" and change.new_from_old is None and change.masks == ()
    assert overlap(change.grid, guest) > 0.5  # of four views' masks alone; the floor under it bounds it below
    assert len(change.masks_in) == OLD
    one = replace(visit.eyes, views=visit.eyes.views)
    alone = estimate_change_paper(stage.capture, stage.field, visit.frames[:1], Models(one, one), CONFIG)
    assert alone.objects == () and "1 new photo alone" in alone.why


def test_nothing_changed_is_an_answer(stage):
    frames = stage.capture.frames[3:24:7]
    stages = []
    eyes = Eyes(known(stage.capture.frames, stage.before))
    change = estimate_change_paper(stage.capture, stage.field, frames, Models(eyes, eyes), CONFIG, stages.append)
    assert change.objects == () and "nothing differs" in change.why and stages == ["detect"]
    plain = estimate_change_paper(stage.capture, stage.field, frames, Models(), CONFIG)
    assert plain.objects == () and "nothing differs" in plain.why


def test_no_photo_and_another_scene_are_refused(stage, moved):
    with pytest.raises(InputError, match="there are none"):
        estimate_change_paper(stage.capture, stage.field, [])
    few = replace(CONFIG, survey=1, most_changed=0.05)
    with pytest.raises(InputError, match="% of the pixels changed; is this the same scene"):
        estimate_change_paper(stage.capture, stage.field, moved.frames[:1], Models(moved.eyes, moved.eyes), few)


def test_without_weights_the_route_ends_in_a_valid_change(stage, moved):
    """GrabCut and SIFT."""
    config = PaperConfig(survey=3, refine=CONFIG.refine)
    change = estimate_change_paper(stage.capture, stage.field, moved.frames[: len(NEW)], Models(), config)
    assert change.why and [p.status for p in change.photos] == ["used"] * len(NEW)
    assert len(change.masks_in) == len(change.masks_out) == (len(NEW) if change.objects else 0)
    for o in change.objects:
        assert 0 <= o.confidence <= 1 and bool((o.grid.values > 0.5).any())
        assert len(o.masks) == (0 if o.kind == "added" else OLD) and len(o.masks_in) == (
            0 if o.kind == "removed" else OLD
        )
        assert all(m is None or (m.shape == (SIZE, SIZE) and m.dtype == torch.bool) for m in o.masks)


# --- pose and refinement ---


def test_refinement_brings_a_rough_pose_home(stage, moved):
    """Eq. 15 on the cube's pixels in the photos."""
    rays, colours = [], []
    for view in moved.views[:2]:
        inner = silhouette(moved.after, "cube", CAMERA, view.frame.world_from_cam).reshape(-1).nonzero()[:, 0][::3]
        rays.append(view.rays[inner])
        colours.append(torch.from_numpy(view.photo.reshape(-1, 3))[inner])
    joined = type(rays[0])(torch.cat([r.origins for r in rays]), torch.cat([r.directions for r in rays]))
    rough = moved.true @ turned_and_shifted(torch.tensor([0.008, -0.006, 0.004, 0, 0, 0.02], dtype=torch.float64))
    better = refine(stage.field, Targets(joined, torch.cat(colours)), rough, RefineConfig(steps=80))
    assert better.steps == 80 and better.loss < 0.2 * better.before
    (d0, m0), (d1, m1) = off(moved, rough), off(moved, better.new_from_old)
    assert d1 < 0.6 * d0 and m1 < 0.5 * m0


def test_refinement_ends_when_its_patience_does():
    field, rays = small_field(1), camera_rays(square_camera(6), camera_at(20, 30, 1.5))
    still = torch.eye(4, dtype=torch.float64)
    with torch.no_grad():
        targets = Targets(rays, moved_colours(field, rays, still))
    done = refine(field, targets, still, RefineConfig(patience=5))
    assert done.steps == 5 and done.loss == done.before < 1e-10 and torch.equal(done.new_from_old, still)


def test_gradients_come_through_a_hash_field():
    """Positions and directions of its encoding are differentiated: a slope by δT is that of the loss."""
    field, rays = small_field(2), camera_rays(square_camera(8), camera_at(20, 30, 1.5))
    aim = torch.full((len(rays), 3), 0.5)

    def loss(delta):
        return (moved_colours(field, rays, turned_and_shifted(delta)) - aim).square().mean()

    delta = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(loss(delta), [delta])
    assert float(slope.norm()) > 0
    step = 2e-4 * slope / slope.norm()
    assert float(loss(-step)) < float(loss(torch.zeros(6, dtype=torch.float64))) < float(loss(step))


def test_delta_turns_and_shifts_without_mixing():
    delta = torch.tensor([0.1, -0.2, 0.3, 0.4, 0.1, -0.7], dtype=torch.float64)
    pose = turned_and_shifted(delta)
    torch.testing.assert_close(pose[:3, 3], delta[:3])
    torch.testing.assert_close(pose[:3, :3], exp(torch.cat([torch.zeros(3).double(), delta[3:]]))[:3, :3])
    assert torch.equal(turned_and_shifted(torch.zeros(6, dtype=torch.float64)), torch.eye(4, dtype=torch.float64))


class Dots:
    """A matcher that takes the middle of the white of each picture for its one feature."""

    def match(self, a, b):
        middles = []
        for image in (a, b):
            light = np.clip(image[..., 0].astype(float) - 100, 0, None)
            v, u = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
            middles.append(np.array([[(u * light).sum(), (v * light).sum()]]) / light.sum())
        return middles[0], middles[1], np.ones(1)


@pytest.mark.parametrize("crop", [0, 60])
def test_matched_pixels_of_an_enlarged_crop_lie_where_they_do_in_the_picture(crop):
    depth = np.full((SIZE, SIZE), 2.0, np.float32)
    pictures = np.zeros((2, SIZE, SIZE, 3), np.float32)
    pictures[0, 31:34, 40:43], pictures[1, 50:53, 22:25] = 1, 1
    masks = np.zeros((2, SIZE, SIZE), bool)
    masks[0, 24:40, 30:50], masks[1, 45:60, 15:33] = True, True
    frame = Frame(None, CAMERA, "a", camera_at(20, 40))
    view = View(frame, CAMERA, pictures[1], pictures[0], depth, np.ones_like(depth))
    pair = Pair(view, to_bytes(pictures[1]), to_bytes(pictures[0]), np.zeros((1, 1, 1)), np.zeros((1, 1, 1)), None)
    sightings = [Sighting(pair, m, 1.0, np.ones(1)) for m in masks]
    found = on_object(*sightings, Dots(), PoseConfig(crop=crop))
    np.testing.assert_allclose(found.uv, [[23.5, 51.5]], atol=0.05)
    np.testing.assert_allclose(found.xyz, view.surface[32, 41][None], atol=2e-3)  # Eq. 10
    beside = replace(sightings[1], mask=np.roll(masks[1], 12, 1))
    assert len(on_object(sightings[0], beside, Dots(), PoseConfig(crop=crop)).uv) == 0


# --- the paper's constants, on made-up inputs ---


def test_boxes_are_five_percent_larger_and_stay_in_the_picture():
    np.testing.assert_allclose(enlarged((10, 20, 50, 40), (100, 100), 1.05), [9, 19.5, 51, 40.5])
    np.testing.assert_allclose(enlarged((0, 0, 100, 80), (80, 100), 1.05), [0, 0, 100, 80])


@pytest.mark.parametrize(("width", "kernel"), [(100, 3), (101, 5), (300, 9), (334, 11)])
def test_the_blur_kernel_is_three_percent_of_the_width_made_odd(width, kernel):
    dot = np.zeros((41, width, 3), np.uint8)
    dot[20, width // 2] = 255
    reach = np.nonzero(blurred(dot, 0.03)[20, :, 0])[0]
    assert reach.min() >= width // 2 - kernel // 2 and reach.max() <= width // 2 + kernel // 2
    sigma = 0.3 * ((kernel - 1) * 0.5 - 1) + 0.8  # OpenCV's rule
    assert blurred(dot, 0.03)[20, width // 2, 0] == pytest.approx(255 / (2 * math.pi * sigma**2), rel=0.25)


@pytest.mark.parametrize(("side", "counts"), [(10, False), (11, True)])
def test_contours_count_from_one_percent_of_the_picture(side, counts):
    """A contour runs through its pixels' middles: 11 of them enclose 10 x 10."""
    unlike = np.zeros((100, 100), np.float32)
    unlike[30 : 30 + side, 50 : 50 + side] = 0.7
    found = contours(unlike, 0.1, DetectConfig())
    assert len(found) == counts
    if counts:
        np.testing.assert_allclose(found[0].box, enlarged((50, 30, 61, 41), (100, 100), 1.05))
    assert contours(unlike, 0.8, DetectConfig()) == ()


def test_what_old_photos_show_too_is_no_change():
    rng = np.random.default_rng(0)
    old = [rng.gamma(2, 0.01, (60, 60)).astype(np.float32) for _ in range(4)]
    level = floor_of(old[:3], DetectConfig())
    assert contours(old[3], level, DetectConfig()) == ()
    assert len(contours(cv2.blur(old[3], (5, 5)), 0.0, DetectConfig())) > 0  # Otsu alone always splits
    new = old[3].copy()
    new[10:25, 20:40] += 0.3
    assert len(contours(new, level, DetectConfig())) == 1
    assert floor_of([], DetectConfig()) == 0


def areas(*values):
    return tuple(Contour(np.zeros(4), float(v), np.zeros((1, 1), bool)) for v in values)


@pytest.mark.parametrize(
    ("views", "merged"),
    [
        ([(90, 80), (95, 85), (170,), (88, 80)], [(), (), (0,), ()]),  # one object; Fig. 13
        ([(90, 80), (170,)], [(), (0,)]),  # as often the one as the other: the larger number
        ([(170,), (160,), (90, 80)], [(), (), ()]),  # most views show one: something left or arrived
        ([(90, 80), (), (88, 84)], [(), (), ()]),  # a view that shows nothing
        ([(9, 8, 7, 6), (9, 8, 7, 6), (17, 8, 7)], [(), (), (0,)]),  # two objects, one of them merged
        ([(9, 8, 7, 6), (9, 8, 7, 6), (9, 8, 7)], [(), (), ()]),  # something is merely hidden
        ([(9, 8, 7, 6), (9, 8, 7, 6), (17, 15)], [(), (), (0, 1)]),  # both merged
        ([(90, 80), (95, 85, 60)], [(), ()]),  # as often the one as the other, but none is large
    ],
)
def test_the_usual_number_of_contours_tells_which_hold_two(views, merged):
    assert overlapping([areas(*v) for v in views], 1.5) == [frozenset(m) for m in merged]


def one_hot(*places):
    """Features (8, 8, 4) with channel k in the k-th quarter listed, and masks (16, 16) of these quarters."""
    features, masks = np.zeros((8, 8, 4)), []
    for channel, (i, j) in places:
        features[4 * i : 4 * i + 4, 4 * j : 4 * j + 4, channel] = 1
        masks.append(np.kron(np.eye(2)[[i]].T * np.eye(2)[[j]], np.ones((8, 8))).astype(bool))
    return features, tuple(masks)


def test_masks_of_one_object_are_found_from_view_to_view_and_before_and_after():
    seen = []
    for before, after in (
        ([(0, (0, 0)), (1, (0, 1))], [(1, (1, 0)), (0, (1, 1))]),
        ([(1, (0, 0)), (0, (0, 1))], [(2, (0, 0)), (1, (1, 0)), (0, (1, 1))]),
        ([(1, (0, 0))], [(0, (1, 0)), (2, (0, 1))]),
    ):
        (was, out), (now, came) = one_hot(*before), one_hot(*after)
        scores = (0.9,) * 4
        seen.append(ViewMasks(Pair(None, None, None, now, was, None), came, out, scores, scores))
    found = associate(seen, 0.5)
    channels = [[None if t is None else int(np.argmax(t.pooled)) for t in (p.gone, p.came)] for p in found]
    assert sorted(channels[:2]) == [[0, 0], [1, 1]] and channels[2] == [None, 2]
    counts = {int(np.argmax(p.came.pooled)): len(p.came.sightings) for p in found}
    assert counts == {0: 3, 1: 2, 2: 2}


def test_the_nearest_ninety_five_percent_of_the_points_are_the_object():
    rng = np.random.default_rng(0)
    surface = rng.uniform(-0.2, 0.2, (10, 10, 3)).astype(np.float32)
    surface[0, :5] += 3  # five of a hundred beside it
    everything = np.ones((10, 10), bool)
    cloud = object_cloud([(SimpleNamespace(surface=surface), everything)], 0.95)
    assert cloud.shape == (95, 3) and np.abs(cloud).max() < 0.21
    surface[9] = np.inf  # the field is empty there
    assert len(object_cloud([(SimpleNamespace(surface=surface), everything)], 0.95)) == round(0.95 * 90)
    assert object_cloud([], 0.95).shape == (0, 3)


def test_a_node_must_lie_in_ninety_five_percent_of_the_masks_that_see_it():
    frame = Frame(None, CAMERA, "a", camera_at(10, 40))
    everything, nothing = np.ones((SIZE, SIZE), bool), np.zeros((SIZE, SIZE), bool)

    def masks(held, missed, unsure=3):
        return [OldMask(frame, CAMERA, m) for m in [nothing] * missed + [None] * unsure + [everything] * held]

    nodes = torch.tensor([[*TARGET], [0, 0, 9.0]])  # in the middle of the picture, and above it
    assert projection_check(nodes, masks(19, 1), 0.95).tolist() == [True, False]
    assert projection_check(nodes, masks(18, 2), 0.95).tolist() == [False, False]
    assert projection_check(nodes, masks(0, 0), 0.95).tolist() == [False, False]
    away = replace(frame, world_from_cam=looking_at(frame.centre, 2 * frame.centre))
    more = [OldMask(away, CAMERA, nothing)] * 5  # photos that do not see it have no say
    assert projection_check(nodes, more + masks(19, 1), 0.95).tolist() == [True, False]


@pytest.mark.parametrize(("confidence", "kept"), [(0.949, False), (0.95, True)])
def test_masks_below_the_papers_confidence_are_left_out(stage, confidence, kept):
    box = []

    def masks(image, boxes):
        box.append(boxes[0])
        return np.ones((1, *image.shape[:2]), bool), np.array([confidence])

    corners = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (0, 0.2)], np.float32)
    frame = stage.capture.frames[0]
    (asked,) = old_masks([frame], corners, SimpleNamespace(masks=masks, sure=0.95), SIZE**2, SegmentConfig())
    assert (asked.mask is not None) == kept == (asked.full() is not None)
    uv = CAMERA.project(transform(invert(frame.world_from_cam), torch.from_numpy(corners)))[0].numpy()
    np.testing.assert_allclose(box[0][2:] - box[0][:2], 1.05 * (uv.max(0) - uv.min(0)), rtol=1e-3)
    (unseen,) = old_masks([frame], corners + 50, SimpleNamespace(masks=None), SIZE**2, SegmentConfig())
    assert not unseen.mask.any()  # that it is not in the picture is known without asking


# --- alignment ---


def texture(seed):
    rng = np.random.default_rng(seed)
    rough = cv2.GaussianBlur(rng.random((160, 160, 3)).astype(np.float32), (0, 0), 1.5)
    return (np.clip(rough * 5 - 2, 0, 1) * 255).astype(np.uint8)


def test_a_render_that_is_a_little_off_is_laid_over_its_photo():
    photo = texture(1)
    true = np.array([[1.004, 0.006, 1.6], [-0.003, 0.998, -1.1], [1e-5, -2e-5, 1]])
    render = warped(photo, np.linalg.inv(true))
    photo = photo.copy()
    photo[60:110, 30:80] = texture(2)[60:110, 30:80]  # what changed is no matter
    warp = found_warp(render, photo, AlignConfig())
    corners = np.array([[[0, 0], [160, 0], [0, 160], [160, 160]]], float)
    apart = cv2.perspectiveTransform(corners, warp) - cv2.perspectiveTransform(corners, true)
    assert np.linalg.norm(apart, axis=-1).max() < 0.5
    mask = np.zeros((160, 160), bool)
    mask[50:90, 40:100] = True
    there_and_back = unwarped(warped(mask.astype(np.uint8), warp) > 0, warp)
    assert (there_and_back ^ mask).sum() < 0.1 * mask.sum()


def test_a_render_is_left_alone_where_nothing_is_gained():
    photo = texture(1)
    assert found_warp(photo, photo, AlignConfig()) is None  # already there
    assert found_warp(np.roll(photo, 12, 1), photo, AlignConfig()) is None  # further than a pose may be off
    assert found_warp(texture(2), photo, AlignConfig()) is None  # nothing in common
    grey = np.full_like(photo, 99)
    assert found_warp(grey, grey, AlignConfig()) is None
    assert warped(photo, None) is photo
