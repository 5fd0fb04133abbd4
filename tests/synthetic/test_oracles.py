"""The exact stand-ins are exact."""

import numpy as np
import pytest
import torch

from refield.field.render import render_camera
from refield.scene.capture import Rays
from refield.scene.change import ObjectChange, SceneChange
from refield.scene.pose import invert, transform
from refield.synthetic.cameras import ring, square_camera
from refield.synthetic.oracles import AnalyticField, KnownView, OracleMatcher, OracleSegmenter
from refield.synthetic.visibility import first_hits, view_hits
from refield.synthetic.worlds import WORLDS

CAMERA = square_camera(40)


@pytest.fixture(scope="module")
def world():
    return WORLDS["table"](0)


@pytest.fixture(scope="module")
def field(world):
    return AnalyticField(world.before)


@pytest.fixture(scope="module")
def views(world):
    """Two views of each state; the pictures are only labels here."""
    rng = np.random.default_rng(0)
    poses = ring(world.target)
    return [
        KnownView(rng.integers(0, 255, (40, 40, 3), dtype=np.uint8), state, CAMERA, poses[i])
        for state, i in ((world.before, 0), (world.before, 1), (world.after, 0), (world.after, 3))
    ]


def rays_through(view, pixels):
    directions = CAMERA.unproject(torch.from_numpy(pixels)) @ view.world_from_cam[:3, :3].T
    return Rays(view.world_from_cam[:3, 3].expand(len(pixels), 3), directions)


def test_the_analytic_field_shows_what_is_there(world, field):
    pose = ring(world.target)[2]
    picture = render_camera(field, CAMERA, pose)
    hits = view_hits(world.before, CAMERA, pose)
    shown = hits.item >= 0
    assert ((picture.opacity > 0.5) == shown).float().mean() > 0.985
    assert (picture.depth - hits.depth)[shown].abs().median() < 0.012
    assert picture.rgb.min() >= 0 and picture.rgb.max() <= 1


def test_its_sampler_misses_nothing(world, field):
    """Every point with density lies in an occupied cell."""
    x = torch.rand(200_000, 3, generator=torch.Generator().manual_seed(0)) * 2.4 - torch.tensor([1.2, 1.2, 0.1])
    assert field.sampler.occupied(x)[field.density(x) > 0].all()


def test_moving_the_world_moves_the_field(world, field):
    """density and colour of the after state at T x = those of the before state at x, inside the object."""
    (change,) = world.changes
    lo, hi = change.old.box()
    x = lo + (hi - lo) * torch.rand(4000, 3, generator=torch.Generator().manual_seed(1)).double()
    x = x[(change.old.distance(x) < -1e-4) & (change.old.distance(x) > -5e-3)]
    after = AnalyticField(world.after)
    d = torch.zeros_like(x)
    sigma, rgb = field(x, d)
    there, colour = after(transform(change.new_from_old, x), d)
    assert torch.allclose(sigma, there, atol=1e-4) and torch.allclose(rgb, colour, atol=1e-4)


def test_the_matcher_follows_the_surface(world, views):
    matcher = OracleMatcher(views, every=1)
    px_a, px_b, score = matcher.match(views[0].image, views[3].image)
    assert len(px_a) == len(px_b) == len(score) > 200
    # rays through matched pixels, carried along with their item, end on the same point of the same item
    ray = [rays_through(views[0], px_a), rays_through(views[3], px_b)]
    hits = [first_hits(v.state, r) for v, r in zip((views[0], views[3]), ray)]
    assert torch.equal(hits[0].item, hits[1].item)
    worlds = [r.origins + h.depth.double()[:, None] * r.directions for h, r in zip(hits, ray)]
    for i in hits[0].item.unique().tolist():
        a, b = (v.state.items[i].world_from_item for v in (views[0], views[3]))
        mine = hits[0].item == i
        local = [transform(invert(pose), x[mine]) for pose, x in zip((a, b), worlds)]
        assert (local[0] - local[1]).norm(dim=-1).max() < 2e-3
    assert 1 in hits[0].item  # the moved box is among them


def test_matching_a_view_with_itself_changes_nothing(views):
    px_a, px_b, _ = OracleMatcher(views).match(views[1].image, views[1].image)
    assert len(px_a) and np.abs(px_a - px_b).max() < 1e-3


def test_the_segmenter_returns_the_item_in_the_box(world, views):
    segmenter = OracleSegmenter(views)
    item = views[0].hits.item.numpy()
    boxes = []
    for i in (1, 2, 3):
        rows, columns = np.nonzero(item == i)
        boxes.append([columns.min() - 0.5, rows.min(), columns.max() + 1, rows.max() + 1.3])
    masks, scores = segmenter.masks(views[0].image, np.array(boxes, float))
    assert all(np.array_equal(masks[k], item == i) for k, i in enumerate((1, 2, 3)))
    assert (scores > 0.8).all() and (scores <= 1).all()
    features = segmenter.features(views[0].image)
    assert features.shape == (40, 40, len(world.before.items) + 1) and (features.sum(-1) == 1).all()


def test_an_unknown_image_is_refused(views):
    with pytest.raises(KeyError, match="not told"):
        OracleSegmenter(views).features(np.zeros((40, 40, 3), np.uint8))


def test_the_commuting_square(world, field):
    """Updating the old world's field by the true change shows the new world."""
    from refield.update.composite import UpdatedField
    from refield.update.learnt import Learnt

    (change,) = world.changes
    true = SceneChange((ObjectChange("moved", change.old.grid(), change.new_from_old),))
    after = AnalyticField(world.after)
    updated = UpdatedField(field, true, Learnt(after))
    for pose in ring(world.target)[::3]:
        wanted, got = (render_camera(f, CAMERA, pose) for f in (after, updated))
        error = (wanted.rgb - got.rgb).abs().amax(-1)
        assert (error < 0.02).float().mean() > 0.985
        assert -10 * torch.log10(((wanted.rgb - got.rgb) ** 2).mean()) > 30
        old = render_camera(field, CAMERA, pose)
        assert ((wanted.rgb - old.rgb) ** 2).mean() > 20 * ((wanted.rgb - got.rgb) ** 2).mean()
