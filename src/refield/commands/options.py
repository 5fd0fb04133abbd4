"""A command's options: all are accepted, `--help` shows those that matter, `--help-all` every one.

The rule: a command's own fields matter, and those of configs that it takes in without a prefix. The fields of other
configs do not, unless their dataclass field says so, ``field(..., metadata={"usual": True})``, and nothing above it
says otherwise (False).
"""

from __future__ import annotations

import importlib
import platform
import types
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, make_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Suppress, arg

Asked = TypeVar("Asked")
HELP, HELP_ALL = ("-h", "--help"), "--help-all"
_NAMES = {Path: "PATH", str: "TEXT", int: "INT", float: "FLOAT"}
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
        tyro.cli(shown(kind, whole=True), args=["--help"], prog=prog)
    if not {*HELP}.isdisjoint(arguments):
        try:
            tyro.cli(shown(kind, whole=False), args=["--help"], prog=prog)
        finally:
            print(_foot(kind, command))
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


def _foot(kind: type[Any], command: str) -> str:
    """What stands below the short help."""
    examples = getattr(importlib.import_module(kind.__module__), "EXAMPLES", ())
    lines = ["examples:", *(f"  {line}" for line in examples), ""] if examples else []
    hidden = len(names(kind)) - len(names(kind, whole=False))
    if hidden:
        lines += [f"{hidden} more options, the settings of every step: refield {command} {HELP_ALL}", ""]
    return "\n".join(lines)


def names(kind: type[Any], *, whole: bool = True, top: bool = True) -> list[str]:
    """The options' names, ``estimate.route``; unless ``whole`` those that matter."""
    hints, out = get_type_hints(kind, include_extras=True), []
    for f in fields(kind):
        hint, marks = _bare(hints[f.name])
        usual = f.metadata.get("usual", top)
        if not is_dataclass(hint):
            out += [f.name] if whole or usual else []
        elif whole or f.metadata.get("usual", True):
            assert isinstance(hint, type)
            own = top and OmitArgPrefixes in marks
            prefix = "" if OmitArgPrefixes in marks else f"{f.name}."
            out += [prefix + name for name in names(hint, whole=whole, top=own)]
    return out


def shown(kind: type[Any], *, whole: bool) -> type[Any]:
    """The same options for the eye of a reader: with ``--help-all``, and unless ``whole`` without those that matter to
    few."""
    out = _shown(kind, whole, top=True)
    help_all = arg(help="show every option and exit", help_behavior_hint="")
    more = ("help_all", Annotated[bool, FlagCreatePairsOff, help_all], field(default=False, kw_only=True))
    return _named_as(make_dataclass(kind.__name__, [more], bases=(out,), frozen=True), kind)


def _shown(kind: type[Any], whole: bool, *, top: bool) -> type[Any]:
    """A subclass, whose help tyro finds in the source of its base; some of its fields are suppressed."""
    hints = get_type_hints(kind, include_extras=True)
    made = []
    for f in fields(kind):
        hint, marks = _bare(hints[f.name])
        default = {k: v for k in ("default", "default_factory") if (v := getattr(f, k)) is not MISSING}
        if is_dataclass(hint):
            assert isinstance(hint, type)
            own = top and OmitArgPrefixes in marks
            hidden = not whole and not (f.metadata.get("usual", True) and names(hint, whole=False, top=own))
            value = f.default if f.default is not MISSING else hint()
            hint = _shown(hint, whole, top=own)
            default = {"default": _copied(hint, value)}
        else:
            hidden = not (whole or f.metadata.get("usual", top))
            marks += () if whole else _short(hint, default.get("default"))
        marks += (Suppress,) if hidden else ()
        made.append((f.name, Annotated[(hint, *marks)] if marks else hint, field(**default, kw_only=f.kw_only)))
    return _named_as(make_dataclass(kind.__name__, made, bases=(kind,), frozen=True), kind)


def _short(hint: Any, default: Any) -> tuple[Any, ...]:
    """How a field's value and default are told briefly: ``--visit INT`` for ``--visit {None}|INT (default: None)``."""
    if hint is bool:
        return (FlagCreatePairsOff, arg(help_behavior_hint=""))
    if get_origin(hint) in (Union, types.UnionType) and default is None:
        kinds = [_NAMES[part] for part in get_args(hint) if part in _NAMES]
        kinds += ["{" + ",".join(get_args(part)) + "}" for part in get_args(hint) if get_origin(part) is Literal]
        return (arg(metavar=kinds[0], help_behavior_hint=""),) if kinds else ()
    return ()


def _named_as(made: type[Any], kind: type[Any]) -> type[Any]:
    made.__doc__, made.__module__, made.__qualname__ = kind.__doc__, kind.__module__, kind.__qualname__
    return made


def _copied(kind: type[Any], value: Any) -> Any:
    """A config's values as one of the subclass shown."""
    values = {}
    for f in fields(kind):
        inner, _ = _bare(f.type)
        part = getattr(value, f.name)
        values[f.name] = _copied(inner, part) if is_dataclass(inner) and isinstance(inner, type) else part
    return kind(**values)


def _bare(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type without its annotations, and these."""
    inner, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    return inner, tuple(marks)
