"""What the old photos saw of a field that has something where nobody ever looked."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from refield.field.radiance import Field, HashField, HashFieldConfig
from refield.scene.camera import Camera
from refield.scene.capture import Frame, Rays
from refield.update.composite import UpdatedField
from refield.update.fit_helper import HelperConfig, HelperTraining, Lit
from refield.update.frozen import Segments
from refield.update.learnt import Learnt, Origin
from refield.update.recall import without
from refield.update.region import move_out
from refield.update.supervision import Lessons
from refield.update.unseen import sight_of
from tests.update.worlds import Ball, BallWorld, at, change_of, moved

SHELL = Ball(at(0.0, 0.0, 0.0), 0.5)
BOX = torch.tensor([[-0.8, -0.8, -0.8], [0.8, 0.8, 0.8]])


def frames() -> list[Frame]:
    """Six photos of the ball, one along each axis and back."""
    camera = Camera(64, 64, 64.0, 64.0, 32.0, 32.0)
    out = []
    for axis in range(3):
        for side in (-2.0, 2.0):
            forward = torch.zeros(3, dtype=torch.float64)
            forward[axis] = -side / 2
            right = torch.zeros(3, dtype=torch.float64)
            right[(axis + 1) % 3] = 1
            pose = torch.eye(4, dtype=torch.float64)
            pose[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], -1)
            pose[:3, 3] = -2 * forward
            out.append(Frame(camera=camera, world_from_cam=pose, path=None, name=f"{axis}{side}"))  # type: ignore[arg-type]
    return out


def asked(field: Field, x: list[list[float]]) -> tuple[list[bool], list[bool]]:
    """Of points: whether their cells are hidden, and whether something may be in them."""
    sight = sight_of(field, frames(), [BOX])
    cells = field.sampler.cells(torch.tensor(x))
    return torch.isin(cells, sight.hidden).tolist(), sight.possible.occupied(torch.tensor(x)).tolist()


def test_what_lies_inside_is_hidden_and_what_was_looked_through_is_empty() -> None:
    points = [[0, 0, 0], [0.5, 0, 0], [0.7, 0, 0], [0, 0, 0.3], [0.6, 0.6, 0]]
    hidden, possible = asked(BallWorld((SHELL,), floor=False), points)
    assert hidden == [True, False, False, True, False]
    assert possible == [True, True, False, True, False]  # of what is inside nobody knows


def test_what_shows_right_beside_something_nearer_was_seen() -> None:
    """A photo's pixel that shows the edge of a ball shows the floor beside it as well."""
    field = BallWorld((Ball(at(0.0, 0.0, 0.6), 0.3),))
    pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    pose[2, 3] = 2.0
    above = replace(frames()[0], world_from_cam=pose)
    sight = sight_of(field, [above], [BOX])
    edge = 2.0 * 0.3 / (1.4**2 - 0.3**2) ** 0.5  # of what the ball hides of the floor

    def hidden(radius: float) -> float:
        turn = torch.arange(360) * torch.pi / 180
        x = torch.stack([radius * turn.cos(), radius * turn.sin(), torch.full_like(turn, -0.01)], -1)
        return float(torch.isin(sight.sampler.cells(x), sight.hidden).float().mean())

    assert hidden(edge - 0.15) == 1.0 and hidden(edge + 0.01) < 0.3


def test_hidden_cells_are_not_shown_unless_something_new_answers_for_them() -> None:
    field = BallWorld((SHELL,), floor=False)
    cells = sight_of(field, frames(), [BOX]).hidden
    x = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.2]])
    change = change_of(moved(Ball(at(0.0, 0.0, 0.0), 0.1), at(2.0, 0.0, 0.0)))
    updated = UpdatedField(field, change, Learnt(BallWorld((Ball(at(0.0, 0.0, 0.0), 0.1),), floor=False)))
    assert updated.sampler.occupied(x).all()
    shown = updated.unshown(cells).sampler.occupied(x)
    assert shown.tolist() == [True, False] and updated.sampler.occupied(x).all()
    # nor at later visits that look the cells up anew, nor when a move is taken back in a state that hides them
    dark = updated.unshown(cells)
    near = change_of(moved(Ball(at(0.0, 0.0, 0.3), 0.15), at(-2.0, 0.0, 0.0)))
    later = UpdatedField(dark, near)
    assert later.sampler.occupied(torch.tensor([[0.12, 0.12, 0.2], [-2.0, 0.0, 0.0]])).tolist() == [False, True]
    back = without(later, Origin(0, 1, 0), departed=True)
    assert isinstance(back, UpdatedField) and isinstance(back.pretrained, UpdatedField)
    assert torch.equal(back.pretrained.unseen, dark.unseen)


def test_a_helper_is_told_what_was_looked_through() -> None:
    change = change_of(moved(SHELL, at(2.0, 0.0, 0.0)))
    wide = move_out(change, 1.5)
    frozen = UpdatedField(BallWorld((SHELL,), floor=False), change, Learnt(region=wide))
    helper = HashField(HashFieldConfig(2, 8, 16, 8, 8, 3), wide.sampler(0.05))
    zeros = torch.zeros
    rays = Rays(zeros(0, 3), zeros(0, 3))
    nothing = Lit(
        Lessons(rays, zeros(0, 3), *(zeros(0, dtype=torch.long) for _ in range(2)), zeros(0, dtype=torch.bool)),
        Segments(zeros(0), zeros(0), zeros(0, 3), zeros(1, dtype=torch.long)),
    )
    sight = sight_of(frozen.pretrained, frames(), [BOX])
    x = torch.tensor([[0.7, 0.0, 0.0], [0.0, 0.0, 0.48]])  # beside the ball; at its surface
    for known, tolls in ((sight, [HelperConfig.emptiness, 0.0]), (None, [0.0, 0.0])):
        run = HelperTraining(helper, frozen, nothing, 0, nothing, HelperConfig(), torch.Generator(), (), known)
        assert run.misplaced[helper.sampler.cells(x)].tolist() == pytest.approx(tolls)
