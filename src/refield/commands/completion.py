"""``refield completion SHELL``: the script that lets a shell complete refield's commands and options."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg
from tyro.extras import subcommand_cli_from_dict

from refield.cli import COMMANDS
from refield.commands.answer import Answer
from refield.commands.options import PLAIN, Output, kind_of, shown

EXAMPLES = (
    "refield completion bash > ~/.local/share/bash-completion/completions/refield",
    'refield completion zsh > "${fpath[1]}/_refield"',
    "refield completion fish > ~/.config/fish/completions/refield.fish",
)

# tyro's scripts offer options where a folder is wanted, and no files: what does not begin as an option is no option,
# and where nothing is left files are.
_FILES_TOO = {
    "bash": """
_refield() {
  _tyro_refield "$@"
  if [[ "${COMP_WORDS[COMP_CWORD]}" != -* ]]; then
    local word kept=()
    for word in "${COMPREPLY[@]}"; do
      [[ -n "$word" && "$word" != -* ]] && kept+=("$word")
    done
    COMPREPLY=("${kept[@]}")
  fi
}
complete -o default -F _refield refield
""",
    "fish": """
function _refield
    set -l found (_tyro_refield | string match --invert '')
    set -l word (commandline -ct)
    if not string match --quiet -- '-*' $word
        set found (string match --invert -- '-*' $found)
    end
    if test -n "$found"
        printf '%s\\n' $found
    else
        __fish_complete_path $word
    end
end
complete --erase --command refield
complete --no-files --command refield --arguments '(_refield)'
""",
}


@dataclass(frozen=True)
class Completion:
    """Print the script that lets a shell complete commands, options, their choices and files with the Tab key."""

    shell: Annotated[Literal["bash", "zsh", "fish"], arg(metavar="SHELL"), Positional]
    """bash, zsh or fish"""
    output: OmitArgPrefixes[Output] = PLAIN


def run(options: Completion) -> Answer:
    text = script(options.shell)
    return Answer({"shell": options.shell, "script": text}, [text])


def script(shell: Literal["bash", "zsh", "fish"]) -> str:
    """What the shell is to read; it runs nothing but Python's interpreter, and loads nothing of ours."""
    kinds: dict[str, Callable[..., Any]] = {name: shown(kind_of(name)) for name in COMMANDS}
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        subcommand_cli_from_dict(kinds, prog="refield", args=["--tyro-print-completion", shell])
    # what is said of an option has to stay on its line
    text = re.sub(
        r"^.*COMPLETION_SPEC = .*$", lambda m: re.sub(r"\\+n", " ", m[0]), said.getvalue(), flags=re.MULTILINE
    )
    return _zsh(text) if shell == "zsh" else text + _FILES_TOO[shell]


def _zsh(text: str) -> str:
    """The same for zsh, whose script ends with the call."""
    kept, call = "  while IFS= read -r line; do\n", "  # Use _describe"
    assert text.count(kept) == 1 and text.count(call) == 1, "tyro's script has changed"
    text = text.replace(
        kept, kept + '    [[ -z "$line" || ( "$line" == -* && "${words[CURRENT]}" != -* ) ]] && continue\n'
    )
    return text.replace(call, "  if (( ! $#completion_array )); then\n    _files\n    return\n  fi\n" + call)
