"""The manual's pages of options, one for each command, read off what ``refield COMMAND --help-all`` prints.

MkDocs calls this at every build (``hooks`` in mkdocs.yml): nothing of these pages is kept by hand, or at all.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING
from unittest.mock import patch

from refield.cli import COMMANDS, main

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

CHAPTER = "Every option"
_COLUMNS = {"COLUMNS": "80"}  # of a wider terminal, boxes stand side by side
_BOX, _RULE = re.compile(r"╭─ (.+?) ─+╮"), re.compile(r"─+")
_DEFAULT = re.compile(r"\s*\((?:default: (?P<default>.*)|(?P<required>required))\)$")
_ALL_TAKE = ("--help", "--help-all")


@dataclass(frozen=True)
class Option:
    """A line of a box: an option or a positional argument."""

    asked: str
    """as it is typed, with what it takes"""
    told: str
    default: str
    """in Markdown; or that it is required; empty where neither is said"""


@dataclass(frozen=True)
class Box:
    """A group of options."""

    title: str
    about: str
    options: tuple[Option, ...]


def help_of(command: str) -> str:
    """What a command prints when it is asked for all of its options."""
    said = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")  # one that can be told lines from letters: there are boxes
    with patch.dict(os.environ, _COLUMNS), contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        main([command, "--help-all"])
    said.seek(0)
    return said.read()


def boxes(text: str) -> list[Box]:
    """The boxes of a help text."""
    out = []
    title, lines = "", list[str]()
    for line in text.splitlines():
        if found := _BOX.fullmatch(line):
            title, lines = found[1], []
        elif line.startswith("╰"):
            out.append(_box(title, lines))
        elif line.startswith("│"):
            lines.append(line.strip("│").rstrip()[1:])
    return out


def _box(title: str, lines: list[str]) -> Box:
    rule = next((i for i, line in enumerate(lines) if _RULE.fullmatch(line)), -1)
    entries: list[list[str]] = []
    for line in lines[rule + 1 :]:
        if line.startswith(" "):
            entries[-1].append(line.strip())
        else:
            entries.append([part for part in re.split(r"\s{2,}", line, maxsplit=1) if part])
    about = " ".join(line.strip() for line in lines[: max(rule, 0)])
    return Box(title, about, tuple(_option(asked, " ".join(told)) for asked, *told in entries))


def _option(asked: str, told: str) -> Option:
    found = _DEFAULT.search(told)
    if found is None:
        return Option(asked, told, "")
    return Option(asked, told[: found.start()], f"`{found['default']}`" if found["default"] else found["required"])


def page(command: str) -> str:
    """A command's options as Markdown."""
    whole, module = help_of(command), import_module(f"refield.commands.{command}")
    about = re.split(r"\n╭", whole.split("\n\n", 1)[1])[0]
    usage = whole.split("\n\n", 1)[0].removeprefix("usage: ")
    parts = [f"# refield {command}", _prose(about), "```sh\n" + "\n".join([usage, *module.EXAMPLES]) + "\n```"]
    for box in boxes(whole):
        kept = [o for o in box.options if not any(o.asked.endswith(name) for name in _ALL_TAKE)]
        rows = [f"| `{o.asked}` | {_prose(o.told)} | {o.default} |" for o in kept]
        if rows:
            head = [f"## {box.title}", _prose(box.about)]
            parts += [*head, "\n".join(["| | | by default |", "|---|---|---|", *rows])]
    return "\n\n".join(p for p in parts if p) + "\n"


def _prose(text: str) -> str:
    """Words that hold no Markdown but ``code``."""
    parts = re.split(r"(``.+?``|`.+?`)", " ".join(text.split()))
    return "".join(p if i % 2 else re.sub(r"([\\*_<>\[\]|#])", r"\\\1", p) for i, p in enumerate(parts))


def contents() -> str:
    """The page before them all."""
    rows = "\n".join(f"| [`refield {name}`]({name}.md) | {_prose(what)} |" for name, what in COMMANDS.items())
    return (
        f"# {CHAPTER}\n\n"
        f"What `refield COMMAND --help-all` prints, as it stood when this was built. `--help` shows those that "
        f"matter to most.\n\n| command | |\n|---|---|\n{rows}\n"
    )


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The chapter's pages, in the order of the commands."""
    assert config.nav is not None
    pages = ["options/index.md", *({f"refield {name}": f"options/{name}.md"} for name in COMMANDS)]
    config.nav = [{CHAPTER: pages} if item == {CHAPTER: "options"} else item for item in config.nav]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The chapter itself."""
    from mkdocs.structure.files import File

    files.append(File.generated(config, "options/index.md", content=contents()))
    for name in COMMANDS:
        files.append(File.generated(config, f"options/{name}.md", content=page(name)))
    return files
