"""The command line: names the commands, and turns what goes wrong into an exit code.

0 done · 1 a fault of ours (with its traceback) · 2 input that cannot be used (one line) · 130 interrupted.
Everything heavy is imported only once a command is chosen.
"""

from __future__ import annotations

import errno
import importlib
import signal
import sys
from collections.abc import Sequence
from types import FrameType

from refield.scene.errors import InputError

COMMANDS = {
    "demo": "sample capture → field → update → report; no downloads, on a CPU",
    "check": "looks photos over before any time is spent on them",
    "train": "photos, with camera poses or without → a field in a workspace",
    "import": "a trained nerfacto of nerfstudio → a field in a workspace (needs the extra 'nerfstudio')",
    "update": "a few new photos → what changed, and the field brought up to date",
    "visits": "what changed at each update of a workspace",
    "undo": "take the last update back",
    "render": "pictures from any camera, before or after",
    "evaluate": "PSNR and SSIM on photos the field has never seen",
    "rehearse": "known changes put into a workspace's own photos: what an update is worth there",
    "synth": "path-trace a world that is known exactly (needs the extra 'synth')",
}
INPUT, INTERRUPTED = 2, 130
_DISK = (errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EPERM, errno.EDQUOT)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        if previous[signal.SIGINT] is signal.default_int_handler:
            signal.signal(signal.SIGINT, _interrupt)
        return _command(arguments)
    except InputError as error:
        return _fail(str(error), INPUT)
    except KeyboardInterrupt:
        return _fail("interrupted; what was complete before is untouched", INTERRUPTED)
    except MemoryError:
        return _fail("out of memory; scale the photos down or give fewer", 1)
    except OSError as error:
        if error.errno not in _DISK:
            raise
        what = f"{error.filename or 'the disk'}: {error.strerror}; check permissions and free space"
        return _fail(what, INPUT)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _command(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_help())
        return 0 if arguments else INPUT
    if arguments[0] == "--version":
        from refield import __version__

        print(f"refield {__version__}")
        return 0
    name = arguments[0]
    if name not in COMMANDS:
        return _fail(f"{name!r} is no command; choose one of {', '.join(COMMANDS)}", INPUT)
    import tyro

    module = importlib.import_module(f"refield.commands.{name}")
    # so that half-built folders are cleared away; after the imports, because pycolmap takes the signal for itself
    signal.signal(signal.SIGTERM, _terminate)
    options = tyro.cli(getattr(module, name.capitalize()), args=arguments[1:], prog=f"refield {name}")
    module.run(options)
    return 0


def _help() -> str:
    lines = [f"  {name:10} {what}" for name, what in COMMANDS.items()]
    head = "refield keeps a radiance field true to a scene whose objects move.\n\nusage: refield COMMAND …\n"
    return "\n".join([head, *lines, "\nrefield COMMAND --help shows a command's options."])


def _fail(message: str, code: int) -> int:
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
