"""What goes wrong with the user's input: one line that says where, what and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class InputError(Exception):
    """Input that cannot be used. Shown as one line; the command line ends with exit code 2."""

    def __init__(self, where: object, what: str, remedy: str) -> None:
        self.where, self.what, self.remedy = str(where), what, remedy
        super().__init__(f"{where}: {what}; {remedy}")


def did_you_mean(given: str, known: Iterable[str]) -> str:
    """``did you mean 'update'? `` where something known is nearly that (a file's name also without its folders and its
    ending), else nothing."""
    folded: dict[str, str] = {}
    for name in known:
        short = name.rpartition("/")[2]
        for form in (short.partition(".")[0], short, name):  # the last one counts where two are alike
            folded[form.lower()] = name
    near = difflib.get_close_matches(given.lower(), folded, n=1, cutoff=0.6)
    return f"did you mean {folded[near[0]]!r}? " if near else ""


def expect(what: str, value: object, kinds: type | tuple[type, ...], give: str) -> None:
    """Check a caller's argument, which ``what`` names.

    Raises:
        TypeError: it is of none of the ``kinds``; the sentence ends with ``give``.
    """
    if not isinstance(value, kinds):
        raise wrong(what, value, give)


def wrong(what: str, value: object, give: str) -> TypeError:
    """A caller's argument is not of its type: a sentence that says what came, and what to give."""
    itself = f" ({value!r})" if isinstance(value, str | int | float) and len(repr(value)) < 60 else ""
    name = type(value).__name__
    came = "None" if value is None else f"{'an' if name[0] in 'aeiouAEIOU' else 'a'} {name}{itself}"
    return TypeError(f"{what} is {came}; give {give}")
