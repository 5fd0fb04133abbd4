"""The command line: names the commands, and turns what goes wrong into an exit code, see `refield.commands.answer`.

Everything heavy is imported only once a command is chosen.
"""

from __future__ import annotations

import errno
import importlib
import os
import signal
import sys
from collections.abc import Sequence
from functools import partial
from types import FrameType
from typing import Any

from refield.commands.answer import Exit, error_document, print_json, told
from refield.scene.errors import InputError, did_you_mean

COMMANDS = {
    "demo": "sample capture → field → update → report; no downloads, on a CPU",
    "check": "looks photos over before any time is spent on them",
    "train": "photos, with camera poses or without → a field in a workspace",
    "import": "a trained nerfacto of nerfstudio → a field in a workspace (needs the extra 'nerfstudio')",
    "update": "a few new photos → what changed, and the field brought up to date",
    "visits": "what changed at each update of a workspace",
    "report": "the scene's history, all visits on one page",
    "undo": "take the last update back",
    "render": "pictures and films from anywhere, before, after and in between",
    "view": "the scene in the browser: visits, before and after, what changed; or as one file to send",
    "export": "points, mesh, splats, cameras and changes for other programs",
    "evaluate": "PSNR and SSIM on photos the field has never seen",
    "rehearse": "known changes put into a workspace's own photos: what an update is worth there",
    "synth": "path-trace a world that is known exactly (needs the extra 'synth')",
    "doctor": "whether refield can run here, and what it would run with",
    "completion": "commands and options completed by the Tab key: bash, zsh, fish",
}
INPUT = Exit.INPUT
_DISK = (errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EPERM, errno.EDQUOT)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    # numpy's and scipy's products are small here: more threads hardly gain, and spin where another program runs
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        if previous[signal.SIGINT] is signal.default_int_handler:
            signal.signal(signal.SIGINT, _interrupt)
        return _command(arguments)
    except InputError as error:
        return _fail(str(error), Exit.INPUT)
    except KeyboardInterrupt:
        return _fail("interrupted; what was complete before is untouched", Exit.INTERRUPTED)
    except MemoryError:
        return _fail("out of memory; scale the photos down or give fewer", Exit.FAULT)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # else Python complains once more when it closes stdout
        return Exit.PIPE
    except OSError as error:
        if error.errno not in _DISK:
            raise
        what = f"{error.filename or 'the disk'}: {error.strerror}; check permissions and free space"
        return _fail(what, Exit.INPUT)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _command(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "--help-all"):
        print(_help())
        return Exit.DONE if arguments else Exit.INPUT
    if arguments[0] == "--version":
        from refield import __version__

        print(f"refield {__version__}")
        return Exit.DONE
    name = arguments[0]
    if name not in COMMANDS:
        near = did_you_mean(name, COMMANDS)
        return _fail(f"{name!r} is no command; {near}choose one of {', '.join(COMMANDS)}", Exit.INPUT)
    module = importlib.import_module(f"refield.commands.{name}")
    # so that half-built folders are cleared away; after the imports, because pycolmap takes the signal for itself
    signal.signal(signal.SIGTERM, _terminate)
    options = _options(name, arguments[1:])
    return told(partial(module.run, options), as_json=options.output.json)


def _options(name: str, arguments: Sequence[str]) -> Any:
    from refield.commands.options import foreword, kind_of, parsed

    try:
        options = parsed(kind_of(name), arguments, name)
    except SystemExit as stop:
        if stop.code and "--json" in arguments:
            print_json(error_document(InputError(f"refield {name}", "wrong usage", f"see refield {name} --help")))
        raise
    except InputError as error:  # a number that a config does not take
        if "--json" in arguments:
            print_json(error_document(error))
        raise
    if options.output.verbose:
        print("\n".join(foreword(options, name)), file=sys.stderr)
    return options


def _help() -> str:
    lines = [f"  {name:10} {what}" for name, what in COMMANDS.items()]
    head = "refield keeps a radiance field true to a scene whose objects move.\n\nusage: refield COMMAND …\n"
    foot = [
        "\nrefield COMMAND --help shows a command's options and examples, --help-all every setting of every step.",
        "exit codes: 0 done · 1 a fault of refield's · 2 input that cannot be used · 130 interrupted ·",
        "with update --exit-code: 10 objects changed · 11 something changed that is not understood",
    ]
    return "\n".join([head, *lines, *foot])


def _fail(message: str, code: Exit) -> int:
    one_line = " ".join(message.split())
    print(f"refield: {one_line}", file=sys.stderr)
    return code


class _Interrupted(KeyboardInterrupt):
    """Ctrl-C. Of a plain KeyboardInterrupt that passes through an ``exec`` of source text (numba's compiler has some)
    CPython dies at the very end, although it was caught; one of another type has no such effect."""


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise _Interrupted


def _terminate(number: int, frame: FrameType | None) -> None:
    raise SystemExit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
