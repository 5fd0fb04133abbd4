"""What a command says at its end, in words for people or as one JSON document for programs, and its exit code."""

from __future__ import annotations

import contextlib
import json
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from refield.scene.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table


class Exit(IntEnum):
    """The exit codes of every command."""

    DONE = 0
    FAULT = 1
    """of refield's, with its traceback; or there is not enough memory"""
    INPUT = 2
    """that cannot be used: one line says where, what and what to do"""
    CHANGED = 10
    """only with ``refield update --exit-code``: objects changed"""
    UNCLEAR = 11
    """only with ``refield update --exit-code``: something changed, and nothing that is understood"""
    INTERRUPTED = 130
    PIPE = 141
    """whoever read what was said has gone"""


@dataclass(frozen=True)
class Answer:
    """What came of a command."""

    document: Mapping[str, Any]
    """the same as the words, for programs; numbers that are not finite become null, paths text"""
    words: Sequence[str | Table] = ()
    code: Exit = Exit.DONE
    stop: BaseException | None = None
    """what ended the command before its end, to be raised when this is told"""


def told(run: Callable[[], Answer | None], *, as_json: bool) -> int:
    """Run a command, tell its answer on stdout, and return its exit code.

    As JSON stdout gets one document whatever happens; of a command that fails it is ``{"error": …}``. What else is
    printed meanwhile goes to stderr then. Each document tells in ``seconds`` how long the command took, where the
    command itself tells nothing else by that name.
    """
    began = time.perf_counter()
    try:
        with contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext():
            answer = run() or Answer({})
    except BaseException as error:
        if as_json:
            print_json(error_document(error))
        raise
    if as_json:
        more = {} if answer.stop is None else error_document(answer.stop)
        print_json({"seconds": round(time.perf_counter() - began, 3), **answer.document, **more})
    else:
        for words in answer.words:
            _say(words)
    if answer.stop is not None:
        raise answer.stop
    return answer.code


def error_document(error: BaseException) -> dict[str, Any]:
    """What went wrong, as data: ``where`` and ``remedy`` are null where nobody knows."""
    if isinstance(error, InputError):
        return {"error": {"where": error.where, "what": error.what, "remedy": error.remedy}}
    kinds = {KeyboardInterrupt: "interrupted", SystemExit: "ended from outside", MemoryError: "out of memory"}
    what = next((words for kind, words in kinds.items() if isinstance(error, kind)), f"{error!r}")
    return {"error": {"where": None, "what": what, "remedy": None}}


def print_json(document: Mapping[str, Any]) -> None:
    """The document alone on stdout, strict JSON."""
    print(json.dumps(_plain(document), indent=1, ensure_ascii=False, allow_nan=False))


def _plain(value: Any) -> Any:
    """As JSON has it."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _say(words: str | Table) -> None:
    if isinstance(words, str):
        print(words)
        return
    from refield.commands.clock import results

    results().print(words)
