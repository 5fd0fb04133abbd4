"""The short help: a command's options that matter, one line or two each, without boxes; it fits on a screen.

What matters is said beside the options, see `refield.commands.options`. Of an option's text the first sentence is
shown; `--help-all` has the rest.
"""

from __future__ import annotations

import ast
import inspect
import re
import shutil
import textwrap
import types
from collections.abc import Iterator
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from tyro.conf import OmitArgPrefixes, Positional

_TAKES = {Path: "PATH", str: "TEXT", int: "INT", float: "NUMBER"}
_COLUMN, _WIDEST = 22, 100  # characters: of the options with what they take, of a line


@dataclass(frozen=True)
class Option:
    """An option or a positional argument, as a command's dataclass has it."""

    name: str
    """as it is typed, without dashes: ``estimate.route``; of a positional argument what stands for it: ``WORK``"""
    hint: Any
    default: Any
    """MISSING where one has to be given"""
    told: str
    positional: bool
    usual: bool
    """whether it matters to most"""

    def asked(self) -> str:
        """How it is typed, with what it takes."""
        if self.positional:
            return self.name
        flag = f"--{'no-' if self.default is True else ''}{self.name.replace('_', '-')}"
        return f"{flag} {_takes(self.hint)}".rstrip()

    def in_short(self) -> str:
        """The first sentence of what is told of it, and its default where that is a value."""
        first = re.split(r"\.\s", " ".join(self.told.split()).replace("``", ""))[0]
        if self.default is MISSING and not self.positional:
            return f"{first} (required)"
        silent = self.default in (MISSING, None, (), Path()) or isinstance(self.default, bool)
        value = " ".join(map(str, self.default)) if isinstance(self.default, tuple) else self.default
        return first if silent else f"{first} (default: {value})"


def options_of(kind: type[Any]) -> list[Option]:
    """All options of a command, in the order in which its dataclass has them."""
    return list(_options(kind, "", top=True, usual=True))


def _options(kind: type[Any], prefix: str, *, top: bool, usual: bool) -> Iterator[Option]:
    hints, told = get_type_hints(kind, include_extras=True), _told(kind)
    for f in fields(kind):
        hint, marks = bare(hints[f.name])
        if is_dataclass(hint):
            assert isinstance(hint, type)
            flat = OmitArgPrefixes in marks
            inner = prefix if flat else f"{prefix}{f.name}."
            yield from _options(hint, inner, top=top and flat, usual=usual and f.metadata.get("usual", True))
        else:
            stands_for = next((mark.metavar for mark in marks if getattr(mark, "metavar", None)), f.name.upper())
            positional = Positional in marks
            name = stands_for if positional else prefix + f.name
            matters = usual and f.metadata.get("usual", top)
            yield Option(name, hint, _default(f), told.get(f.name, ""), positional, matters)


def brief(kind: type[Any], command: str, *, examples: tuple[str, ...], rest: str) -> str:
    """The short help of a command; ``rest`` is the option that shows all of them."""
    options = options_of(kind)
    places = [o for o in options if o.positional]
    shown = [o for o in options if o.usual and not o.positional and o.name not in _OF_ALL]
    rows = [(o.asked(), o.in_short()) for o in shown] + [_OF_EVERY_COMMAND]
    hidden = sum(not o.usual for o in options)
    parts = [
        "\n".join(_wrapped("usage: ", f"refield {command} [OPTIONS] {' '.join(o.name for o in places)}".rstrip())),
        "\n".join(_wrapped("", re.sub(r"\s+", " ", inspect.getdoc(kind) or ""))),
        _table([(o.name, o.in_short()) for o in places]),
        "options:\n" + _table(rows),
        "examples:\n" + "\n".join(f"  {line}" for line in examples) if examples else "",
        f"{hidden} more options, the settings of every step: refield {command} {rest}" if hidden else "",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


_OF_ALL = ("json", "quiet", "verbose")
_OF_EVERY_COMMAND = (
    "--json, --quiet, --verbose",
    "one JSON document in place of words; no progress; more of what is done",
)


def _table(rows: list[tuple[str, str]]) -> str:
    """What is typed on the left, what is told of it on the right; below, where the left one is too long."""
    lines = []
    for asked, told in rows:
        head = f"  {asked}".ljust(_COLUMN)
        own = len(head) >= _COLUMN and head[-1] != " "
        lines += [head] if own else []
        lines += _wrapped(" " * _COLUMN if own else head, told)
    return "\n".join(lines)


def _wrapped(head: str, text: str) -> list[str]:
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    found = textwrap.wrap(
        text, max(width, 40), initial_indent=head, subsequent_indent=" " * len(head), break_on_hyphens=False
    )
    return found or [head.rstrip()]


def _takes(hint: Any) -> str:
    """What an option takes: ``INT``, ``cpu|cuda``; nothing of a switch."""
    hint, _ = bare(hint)
    parts = [part for part in get_args(hint) if part not in (type(None), Ellipsis)]
    if get_origin(hint) is Literal:
        return "|".join(map(str, parts))
    if get_origin(hint) in (Union, types.UnionType):
        return "|".join(_takes(part) for part in parts)
    if get_origin(hint) is tuple:
        return f"{_takes(parts[0])} …"
    return "" if hint is bool else _TAKES[hint]


def _told(kind: type[Any]) -> dict[str, str]:
    """The text under each field, as it stands in the source."""
    out: dict[str, str] = {}
    for base in reversed([base for base in kind.__mro__ if is_dataclass(base)]):
        (made,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(made, ast.ClassDef)
        for line, under in zip(made.body, made.body[1:]):
            match line, under:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(told))):
                    out[name] = told
    return out


def _default(f: Field[Any]) -> Any:
    return f.default_factory() if f.default_factory is not MISSING else f.default


def bare(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """A type without its annotations, and these."""
    inner, *marks = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    return inner, tuple(marks)
