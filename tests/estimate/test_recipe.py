"""What changed, end to end, on worlds that are known in closed form."""

from dataclasses import replace

import pytest
import torch

from refield.estimate.ground import AssociateConfig
from refield.estimate.models import Models
from refield.estimate.recipe import EstimateConfig, estimate_change
from refield.field.source import Known
from refield.scene.errors import InputError
from refield.scene.images import frame_image, write_image
from refield.scene.pose import angle_between, transform
from refield.vision.segmenter import GrabCutSegmenter
from tests.estimate.boxes import BoxWorld, capture_of, new_photos, standing, turn

CRATE = standing((0.2, 0.17, 0.18), -0.25, -0.2, 20, paint=3)
DRUM = standing((0.15, 0.15, 0.2), 0.4, 0.35, -10, paint=5)
BEFORE = BoxWorld((CRATE, DRUM))


@pytest.fixture(scope="module")
def old(tmp_path_factory):
    return capture_of(BEFORE, tmp_path_factory.mktemp("before"))


def estimate(old, after, folder):
    stages, counts = [], []
    change = estimate_change(
        old, BEFORE, new_photos(after, folder), EstimateConfig(survey=6), stages.append,
        on_count=lambda done, total: counts.append((done, total)),
    )  # fmt: skip
    assert stages[0] == "detect"
    made = [done for done, _ in counts]
    assert made == sorted(made) and set(made) == set(range(len(set(made))))
    assert bool(counts) == ("pose" in stages) and all(done == total for done, total in counts[-1:])
    return change


def centre(box):
    return box.world_from_box[:3, 3]


def overlap(grid, box):
    """(part of a box that a grid holds, IoU)."""
    lo = torch.minimum(grid.tight_aabb()[0], centre(box).float() - 0.4)
    hi = torch.maximum(grid.tight_aabb()[1], centre(box).float() + 0.4)
    x = lo + (hi - lo) * torch.rand(200_000, 3, generator=torch.Generator().manual_seed(0))
    a, b = grid.contains(x), box.inside(x)
    return float((a & b).sum() / b.sum()), float((a & b).sum() / (a | b).sum())


def test_a_moved_box_is_found_with_its_pose_shape_and_masks(old, tmp_path):
    true = turn(centre(CRATE), 50, (0.35, -0.15, 0))
    change = estimate(old, BoxWorld((CRATE.moved(true), DRUM)), tmp_path)
    (moved,) = change.objects
    assert moved.kind == "moved"
    assert float(angle_between(moved.new_from_old, true)) < 0.7
    c = centre(CRATE)
    assert float((transform(moved.new_from_old, c) - transform(true, c)).norm()) < 0.006
    held, iou = overlap(moved.grid, CRATE)
    assert held > 0.88 and iou > 0.8
    assert torch.linalg.eigvalsh(moved.covariance).min() > 0
    assert f"1 moved by {float(moved.shift.norm()):.4g} " in change.why  # as the report tells it
    assert len(moved.masks) == len(moved.masks_in) == len(old.train)
    assert all(m.shape == (80, 80) and m.dtype == torch.bool for m in moved.masks)
    assert len(change.masks_in) == 4 and change.frames[0].name == "000.png"
    assert moved.confidence > 0.9


def test_the_papers_masks_can_take_the_place_of_ours(old, tmp_path):
    true = turn(centre(CRATE), 50, (0.35, -0.15, 0))
    photos = new_photos(BoxWorld((CRATE.moved(true), DRUM)), tmp_path)
    asked = []

    class Asked(GrabCutSegmenter):
        def features(self, image):
            asked.append(image)
            return super().features(image)

    config = EstimateConfig(survey=6, masks="paper")
    (moved,) = estimate_change(old, BEFORE, photos, config, models=Models(segmenter=Asked())).objects
    assert len(asked) == 2 * (len(photos) + config.survey)  # pictures of both kinds, which ours does not ask about
    assert moved.kind == "moved" and float(angle_between(moved.new_from_old, true)) < 1.5


def test_a_box_tipped_onto_another_face_is_found(old, tmp_path):
    true = turn(centre(CRATE), 90, (0.3, -0.2, -0.01), axis=(0, 1, 0))
    (moved,) = estimate(old, BoxWorld((CRATE.moved(true), DRUM)), tmp_path).objects
    assert moved.kind == "moved" and float(angle_between(moved.new_from_old, true)) < 1.5


def test_two_boxes_that_touched_may_each_have_their_own_change(tmp_path):
    """Small photos without noise explain 0.72 of the right box at its place, so that less than usual is asked."""
    beside = standing((0.09, 0.09, 0.28), -0.25 + 0.29, -0.2, 0, paint=7)
    crate = standing((0.2, 0.17, 0.18), -0.25, -0.2, 0, paint=3)
    before = capture_of(BoxWorld((crate, beside)), tmp_path / "before")
    true = turn(centre(crate), 50, (0.1, 0.5, 0))
    photos = new_photos(BoxWorld((crate.moved(true),)), tmp_path)
    config = EstimateConfig(survey=6, associate=AssociateConfig(shown=0.65))
    change = estimate_change(before, BoxWorld((crate, beside)), photos, config)
    assert sorted(o.kind for o in change.objects) == ["moved", "removed"]
    (moved,) = [o for o in change.objects if o.kind == "moved"]
    assert float(angle_between(moved.new_from_old, true)) < 1.5
    assert overlap(moved.grid, crate)[1] > 0.8


def test_a_removed_box_is_found(old, tmp_path):
    (gone,) = estimate(old, BoxWorld((DRUM,)), tmp_path).objects
    assert gone.kind == "removed" and gone.new_from_old is None
    held, iou = overlap(gone.grid, CRATE)
    assert held > 0.88 and iou > 0.8


def test_an_added_box_is_found(old, tmp_path):
    guest = standing((0.16, 0.16, 0.16), 0.1, -0.45, 35, paint=9)
    (new,) = estimate(old, BoxWorld((CRATE, DRUM, guest)), tmp_path).objects
    assert new.kind == "added" and new.masks == ()
    assert overlap(new.grid, guest)[1] > 0.4


def test_what_arrived_in_the_only_photo_is_told_with_doubt(old, tmp_path):
    photos = new_photos(BoxWorld((CRATE, DRUM, standing((0.16, 0.16, 0.16), 0.1, -0.45, 35, paint=9))), tmp_path)
    by_all, by_one = (estimate_change(old, BEFORE, some, EstimateConfig(survey=6)) for some in (photos, photos[:1]))
    assert [o.kind for o in by_one.objects] == [o.kind for o in by_all.objects] == ["added"]
    assert by_one.objects[0].confidence < 0.25 < 0.5 < by_all.objects[0].confidence
    assert "one photo does not tell" in by_one.why and "one photo" not in by_all.why


def test_what_left_where_another_came_is_told_with_doubt(old, tmp_path):
    guest = standing((0.16, 0.16, 0.16), 0.1, -0.55, 35, paint=9)
    change = estimate(old, BoxWorld((DRUM, guest)), tmp_path)
    assert sorted(o.kind for o in change.objects) == ["added", "removed"]
    assert all(o.confidence < 0.5 for o in change.objects)
    assert "or it moved, and shows a side that no old photo saw" in change.why


def test_nothing_changed_is_an_answer(old, tmp_path):
    change = estimate(old, BEFORE, tmp_path)
    assert change.objects == () and change.why


def test_old_photos_given_as_new_have_not_changed(old):
    assert estimate_change(old, BEFORE, old.frames[:4], EstimateConfig(survey=6)).objects == ()


def test_another_scene_is_refused(old, tmp_path):
    wall = standing((0.95, 0.95, 0.5), 0, 0, 0, paint=-1)
    with pytest.raises(InputError, match="% of the pixels changed; is this the same scene"):
        estimate(old, BoxWorld((wall,)), tmp_path)


def test_a_scene_of_which_much_changed_is_told_from_another(old, tmp_path):
    """By the pixels that are as the field shows them from there, of two photos or more."""
    true = turn(centre(CRATE), 50, (0.35, -0.15, 0))
    little = EstimateConfig(survey=6, most_changed=0.005)  # of a photo's pixels
    photos = new_photos(BoxWorld((CRATE.moved(true), DRUM)), tmp_path / "moved")
    change = estimate_change(old, BEFORE, photos, little)
    assert [o.kind for o in change.objects] == ["moved"] and all(p.status == "used" for p in change.photos)
    path, shape = tmp_path / "noise.png", (photos[0].camera.height, photos[0].camera.width, 3)
    write_image(path, torch.rand(shape, generator=torch.Generator().manual_seed(0)))
    noise = replace(photos[0], path=path, name="noise.png")
    swapped = replace(photos[1], world_from_cam=photos[2].world_from_cam, name="swapped.png")
    change = estimate_change(old, BEFORE, [noise, swapped, *photos], little)
    assert [p.status for p in change.photos] == ["rejected", "rejected", "used", "used", "used", "used"]
    with pytest.raises(InputError, match="is this the same scene"):  # one alone may be by chance
        estimate_change(old, BEFORE, photos[:1], little)


def test_a_field_that_does_not_show_its_own_photos_is_refused(old, tmp_path):
    wall = BoxWorld((standing((0.95, 0.95, 0.5), 0, 0, 0, paint=-1),))
    with pytest.raises(InputError, match="the field: it shows its own photos hardly better"):
        estimate_change(old, wall, new_photos(BEFORE, tmp_path), EstimateConfig(survey=6))


def test_an_object_that_an_earlier_visit_found_is_not_segmented_again(old, tmp_path):
    """§11.3.2: only its old pictures are looked at, and the shape is the one that was known."""
    true = turn(centre(CRATE), 50, (0.35, -0.15, 0))
    photos = new_photos(BoxWorld((CRATE.moved(true), DRUM)), tmp_path)
    first = estimate_change(old, BEFORE, photos, EstimateConfig(survey=6)).objects[0]
    asked = []

    class Asked(GrabCutSegmenter):
        def masks(self, image, boxes, hint=None):
            asked.append(boxes)
            return super().masks(image, boxes, hint)

    models = Models(segmenter=Asked())
    (again,) = estimate_change(
        old, BEFORE, photos, EstimateConfig(survey=6), models=models, known=[Known(first.grid)]
    ).objects
    assert again.kind == "moved" and len(asked) <= len(photos)
    assert float(angle_between(again.new_from_old, true)) < 0.7
    inside = overlap(again.grid, CRATE)[1]
    assert abs(inside - overlap(first.grid, CRATE)[1]) < 0.05
    assert len(again.masks) == len(old.train)


def test_what_nothing_rigid_explains_is_told_and_not_invented(old, tmp_path):
    """Each photo shows another scribble before the same box: no solid thing looks like that."""
    photos = new_photos(BEFORE, tmp_path)
    rng = torch.Generator().manual_seed(3)
    for frame in photos:
        image = frame_image(frame).clone()
        h, w = image.shape[:2]
        image[h // 3 : 2 * h // 3, w // 3 : 2 * w // 3] = torch.randint(0, 255, (3,), generator=rng).byte()
        write_image(frame.path, image)
    change = estimate_change(old, BEFORE, photos, EstimateConfig(survey=6))
    assert all(o.kind == "added" for o in change.objects)  # nothing that was there is said to have moved or left
    assert change.objects or ("not understood" in change.why and len(change.unexplained) == 4)
    assert all(m.shape == (80, 80) for m in change.unexplained)


def test_two_boxes_that_changed_places_are_told_apart(old, tmp_path):
    def to(a, b, degrees):
        shift = centre(b) - centre(a)
        return turn(centre(a), degrees, (float(shift[0]), float(shift[1]), 0))

    there, back = to(CRATE, DRUM, 25), to(DRUM, CRATE, -40)
    change = estimate(old, BoxWorld((CRATE.moved(there), DRUM.moved(back))), tmp_path)
    assert [o.kind for o in change.objects] == ["moved", "moved"]
    for box, true in ((CRATE, there), (DRUM, back)):
        (found,) = (o for o in change.objects if bool(o.grid.contains(centre(box).float())))
        assert float(angle_between(found.new_from_old, true)) < 1.5
        assert float((transform(found.new_from_old, centre(box)) - transform(true, centre(box))).norm()) < 0.012
    assert len({o.note for o in change.objects}) == 2 and all(0.5 < o.confidence <= 1 for o in change.objects)
