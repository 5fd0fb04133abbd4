"""Ground that is not flat: what stands on it touches it and sinks in nowhere, and the true change is known still."""

import pytest
import torch

from refield.commands.synth import Synth, run
from refield.scene.capture import Rays
from refield.scene.errors import InputError
from refield.scene.pose import transform
from refield.synthetic.grounds import on_ground
from refield.synthetic.shapes import Box
from refield.synthetic.visibility import first_hits
from refield.synthetic.worlds import WORLDS
from refield.synthetic.write import SynthConfig


@pytest.fixture(scope="module")
def worlds():
    return {(n, g): on_ground(WORLDS[n](0), g, 0) for n in ("cube", "sphere") for g in ("wavy", "cluttered")}


def surface(item, count=20_000):
    """World points (N, 3) in and on an item, many of them where it stands."""
    half = torch.tensor(item.solid.half, dtype=torch.float64)
    points = (torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 2 - 1) * half
    if isinstance(item.solid, Box):
        points[: count // 2, 2] = -half[2]  # its foot
    else:
        points = points / points.norm(dim=-1, keepdim=True) * half
    return transform(item.world_from_item, points)


@pytest.mark.parametrize("ground", ["wavy", "cluttered"])
@pytest.mark.parametrize("name", ["cube", "sphere"])
def test_what_stands_touches_the_ground_and_does_not_sink_in(worlds, name, ground):
    world = worlds[name, ground]
    for state in (world.before, world.after):
        item = state.named(name)
        points = surface(item)
        gaps = torch.stack([other.distance(points) for other in state.items if other.name != name]).amin(0)
        assert -0.008 < gaps.min() < 0.004
        assert gaps.max() > 0.1


@pytest.mark.parametrize("ground", ["wavy", "cluttered"])
def test_the_ground_is_not_flat_where_the_object_was_and_is(worlds, ground):
    world = worlds["cube", ground]
    things = [item.name for item in world.before.items if item.name.startswith("thing")]
    x = torch.linspace(-0.5, 0.5, 60)
    origins = torch.cat([torch.cartesian_prod(x, x), torch.full((3600, 1), 3.0)], -1)
    down = torch.tensor([0, 0, -1.0]).expand(3600, 3)
    depth = first_hits(world.before.without("cube", *things), Rays(origins, down)).depth
    assert depth.isfinite().all() and depth.max() - depth.min() > 0.01


def test_the_change_is_the_object_alone_and_leans_on_waves(worlds):
    for (name, ground), world in worlds.items():
        (change,) = world.changes
        assert (change.kind, change.old.name) == ("moved", name)
        upright = change.new_from_old[2, :3]
        leans = not torch.allclose(upright, torch.tensor([0, 0, 1.0], dtype=torch.float64), atol=1e-6)
        assert leans == (ground == "wavy")
        moved = change.new.world_from_item[:2, 3] - change.old.world_from_item[:2, 3]
        assert torch.allclose(moved, torch.tensor([0.227, 0.227], dtype=torch.float64))


def test_small_things_stand_beside_what_moves(worlds):
    world = worlds["cube", "cluttered"]
    things = [item for item in world.before.items if item.name.startswith("thing")]
    assert len(things) > 20
    points = torch.cat([surface(state.named("cube")) for state in (world.before, world.after)])
    assert min(float(t.distance(points).min()) for t in things) > 0


def test_the_ground_follows_from_the_seed():
    one, same, other = (on_ground(WORLDS["cube"](s), "wavy", s) for s in (0, 0, 1))
    assert one.before.items[0].solid == same.before.items[0].solid != other.before.items[0].solid


def test_flat_ground_is_the_world_itself_and_what_is_stacked_stays_on_it():
    world = WORLDS["cube"](0)
    assert on_ground(world, "flat", 0) is world
    with pytest.raises(InputError, match="does not stand on the floor"):
        on_ground(WORLDS["stacked"](0), "wavy", 0)


def test_the_world_random_has_a_ground_of_its_own(tmp_path):
    with pytest.raises(InputError, match="--ground"):
        run(Synth("random", tmp_path / "x", config=SynthConfig(ground="wavy")))
