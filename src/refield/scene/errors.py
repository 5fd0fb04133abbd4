"""What goes wrong with the user's input: one line that says where, what and what to do."""

from __future__ import annotations


class InputError(Exception):
    """Input that cannot be used. Shown as one line; the command line ends with exit code 2."""

    def __init__(self, where: object, what: str, remedy: str) -> None:
        self.where, self.what, self.remedy = str(where), what, remedy
        super().__init__(f"{where}: {what}; {remedy}")
