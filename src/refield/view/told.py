"""What changed at a visit as a few lines of HTML, for the panel and for the page that is sent to somebody."""

from __future__ import annotations

from html import escape

from refield.report import words
from refield.scene.change import SceneChange
from refield.scene.world import World
from refield.view.marks import IS, WAS


def told(visit: int, change: SceneChange | None, world: World) -> str:
    """A heading and a numbered list: what, how far, how sure. ``change`` is None for the state before any visit."""
    if change is None:
        return "<p><b>Before any visit</b>: as the first photos show it.</p>"
    head = f"<p><b>Visit {visit}</b>: {escape(words.headline(change))}.</p>"
    why = f"<p>Why: {escape(change.why)}.</p>" if change.why and not change.objects else ""
    items = []
    for number, o in enumerate(change.objects, 1):
        sure = "as somebody said" if change.by_hand else words.sure(o.confidence)
        around = words.give_or_take(o, world)
        more = "; ".join(escape(part) for part in (sure, around) if part)
        items.append(f"<li>{escape(words.sentence(number, o, world))}<br><small>{more}</small></li>")
    listed = f"<ol>{''.join(items)}</ol><p><small>{_KEY}</small></p>" if items else ""
    return f"{head}{why}{listed}"


def _key(rgb: tuple[int, int, int], words_: str) -> str:
    return f'<span style="color:rgb{rgb}">&#9632;</span> {words_}'


_KEY = f"{_key(IS, 'where it is')}, {_key(WAS, 'where it was')}"
