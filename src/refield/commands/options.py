"""A command's options: all are accepted, `--help` shows those that matter, `--help-all` every one.

The rule: a command's own fields matter, and those of configs that it takes in without a prefix. The fields of other
configs do not, unless their dataclass field says so, ``field(..., metadata={"usual": True})``, and nothing above it
says otherwise (False).
"""

from __future__ import annotations

import importlib
import platform
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, make_dataclass
from importlib.metadata import version
from typing import Annotated, Any, TypeVar

import tyro
from tyro.conf import FlagCreatePairsOff, arg

from refield.commands.brief import brief, options_of

Asked = TypeVar("Asked")
HELP, HELP_ALL = ("-h", "--help"), "--help-all"
_Switch = Annotated[bool, FlagCreatePairsOff]


@dataclass(frozen=True)
class Output:
    """What is told, and how."""

    json: _Switch = False
    """one JSON document on stdout in place of words; all else goes to stderr"""
    quiet: _Switch = False
    """no progress; warnings and faults are still told"""
    verbose: _Switch = False
    """tell versions and settings first, and what memory was taken after each stage"""


PLAIN = Output()


def kind_of(command: str) -> type[Any]:
    """The dataclass with a command's options."""
    return getattr(importlib.import_module(f"refield.commands.{command}"), command.capitalize())


def parsed(kind: type[Asked], arguments: Sequence[str], command: str) -> Asked:
    """What the arguments ask for.

    Raises:
        SystemExit: they cannot be understood (2), or ask for help (0).
    """
    prog = f"refield {command}"
    if HELP_ALL in arguments:
        tyro.cli(shown(kind), args=["--help"], prog=prog)
    if not {*HELP}.isdisjoint(arguments):
        examples = getattr(importlib.import_module(kind.__module__), "EXAMPLES", ())
        print(brief(kind, command, examples=examples, rest=HELP_ALL))
        raise SystemExit(0)
    return tyro.cli(kind, args=list(arguments), prog=prog)


def foreword(options: Any, command: str) -> list[str]:
    """Versions, and the settings that are not the usual ones."""
    from refield import __version__

    packages = ", ".join(f"{name} {version(name)}" for name in ("torch", "numba", "pycolmap"))
    usual = {f.name: f.default for f in fields(options) if f.default is not MISSING}
    usual |= {f.name: f.default_factory() for f in fields(options) if f.default_factory is not MISSING}
    settings = [
        line for f in fields(options) for line in _differing(f.name, getattr(options, f.name), usual.get(f.name))
    ]
    return [f"refield {__version__} {command}, Python {platform.python_version()}, {packages}", *settings]


def _differing(name: str, value: Any, usual: Any) -> list[str]:
    """``name: value`` of everything in ``value`` that is not as usual."""
    if is_dataclass(value) and type(value) is type(usual):
        parts = [_differing(f"{name}.{f.name}", getattr(value, f.name), getattr(usual, f.name)) for f in fields(value)]
        return [line for part in parts for line in part]
    return [] if value == usual else [f"           {name.replace('_', '-')}: {value}"]


def names(kind: type[Any], *, whole: bool = True) -> list[str]:
    """The options' names, ``estimate.route``; unless ``whole`` those that matter."""
    return [option.name for option in options_of(kind) if whole or option.usual]


def shown(kind: type[Any]) -> type[Any]:
    """The same options with ``--help-all``, for the eye of a reader: a subclass, whose help tyro finds in the source of
    its base."""
    help_all = arg(help="show every option and exit", help_behavior_hint="")
    more = ("help_all", Annotated[bool, FlagCreatePairsOff, help_all], field(default=False, kw_only=True))
    made = make_dataclass(kind.__name__, [more], bases=(kind,), frozen=True)
    made.__doc__, made.__module__, made.__qualname__ = kind.__doc__, kind.__module__, kind.__qualname__
    return made
