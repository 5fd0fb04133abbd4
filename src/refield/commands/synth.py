"""``refield synth WORLD OUT``: path-trace a world that is known exactly, with masks and the true change.

The world ``random`` draws all from its seed; `random_write` lays it out as the others, and adds ``truth/world.json``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from refield.artefacts import writable
from refield.commands.answer import Answer
from refield.commands.clock import Clock
from refield.commands.options import PLAIN, Output
from refield.scene.errors import InputError
from refield.synthetic.random_write import write_random
from refield.synthetic.write import SynthConfig, write_world
from refield.workspace import refuse_inside

RANDOM = "random"
_OF_RANDOM = {"photos": "give --cameras for {}", "path": "leave it out", "mixed": "leave it out"}


EXAMPLES = ("refield synth cube out", "refield synth random out --seed 7")


@dataclass(frozen=True)
class Synth:
    """Photograph a known world before and after a change (needs Mitsuba: pip install 'refield[synth]')."""

    world: Annotated[str, arg(metavar="WORLD"), Positional]
    """the world's name, or random: all of it drawn from --seed; an unknown one lists them all"""
    out: Annotated[Path, arg(metavar="OUT"), Positional]
    """the folder for before/, after/, eval/ and truth/"""
    into: Path | None = None
    """a workspace: the objects of the world random are put into its photos, as `refield rehearse` does (needs no
    Mitsuba); of the config options only --seed counts"""
    overwrite: bool = False
    """write into a folder that is not empty"""
    config: OmitArgPrefixes[SynthConfig] = field(default_factory=SynthConfig)
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Synth) -> Answer:
    clock = Clock(quiet=options.output.quiet, verbose=options.output.verbose)
    _refuse_unless_free(options.out, overwrite=options.overwrite)
    _refuse_the_others_options(options)
    if options.into is not None:
        return _into(options, options.into, clock)
    clock.stage(f"path-trace {options.world}")
    with writable(options.out), clock.counting("photos") as count:
        if options.world == RANDOM:
            write_random(options.out, options.config, on_progress=count)
        else:
            told = asdict(options.config)
            named = {name: value for name, value in told.items() if name not in _OF_RANDOM}
            write_world(options.world, options.out, **named, on_progress=count)
    clock.stop()
    facts = {"world": options.world, "out": options.out, "seconds": clock.total}
    return Answer(facts, [f"{options.world} is in {options.out} ({clock.total:.0f} s)"])


def _into(options: Synth, work: Path, clock: Clock) -> Answer:
    """Put objects into the photos of a workspace."""
    from refield.commands.rehearse import opened
    from refield.rehearse.compose import compose, divided, scenery_of

    if options.world != RANDOM:
        raise InputError("--into", f"does not go with the world {options.world!r}", "give the world 'random'")
    workspace = opened(work)
    capture = workspace.capture()
    divided(capture)
    clock.stage("find out how far off things are")
    with clock.counting("views") as count:
        scenery = scenery_of(workspace.field(), capture, count)
    clock.stage("put objects into the photos")
    with writable(options.out), clock.counting("photos") as count:
        plan = compose(scenery, options.out, options.config.seed, count)
    clock.stop()
    facts = {"world": options.world, "out": options.out, "seconds": clock.total, "happening": plan.facts["happening"]}
    return Answer(facts, [f"{plan.facts['happening']}: {options.out} ({clock.total:.0f} s)"])


def _refuse_the_others_options(options: Synth) -> None:
    if options.world == RANDOM and options.config.cameras is not None:
        raise InputError("--cameras", "is for the worlds that have a name", "give --photos for the world random")
    if options.world == RANDOM and options.config.ground != "flat":
        raise InputError("--ground", "is for the worlds that have a name", "leave it out for the world random")
    for name, instead in _OF_RANDOM.items():
        if options.world != RANDOM and getattr(options.config, name):
            raise InputError(f"--{name}", f"is for the world {RANDOM}", instead.format(options.world))


def _refuse_unless_free(out: Path, *, overwrite: bool) -> None:
    refuse_inside(out)
    if out.exists() and not out.is_dir():
        raise InputError(out, "is a file, not a folder", "choose another output folder")
    if out.exists() and any(out.iterdir()) and not overwrite:
        raise InputError(out, "is not empty", "choose an empty folder, or pass --overwrite to write into it")
