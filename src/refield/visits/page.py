"""A visit's report: the pictures and numbers of one update, gathered for `refield.report`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from refield.evaluate import Report
from refield.field.volrend import Rendering
from refield.report import Comparison, VisitReport
from refield.scene.change import SceneChange
from refield.scene.images import frame_image
from refield.visits.telling import Telling


def page(
    title: str,
    change: SceneChange,
    shown: tuple[Sequence[Rendering], Sequence[Rendering] | None],
    telling: Telling,
    evaluation: Report | None,
    facts: Mapping[str, float | str],
) -> VisitReport:
    """``shown`` is what the old field and the updated one (None if nothing changed) show, (H, W), from where the used
    new photos were taken."""
    return VisitReport(
        title,
        change,
        photos=_photos(change, *shown),
        seconds=dict(telling.seconds),
        evaluation=None if evaluation is None else evaluation.to_dict(),
        evaluation_views=() if evaluation is None else evaluation_views(evaluation),
        facts=dict(facts),
        warnings=tuple(telling.warnings),
    )


def evaluation_views(evaluation: Report) -> tuple[Comparison, ...]:
    """The evaluation's pictures; without an update the old field's are its only ones."""
    return tuple(
        Comparison(
            name=v.name,
            photo=v.truth,
            before=v.render if v.render_before is None else v.render_before,
            after=None if v.render_before is None else v.render,
            mask_in=v.mask_in,
            mask_out=v.mask_out,
            frame=v.frame,
        )
        for v in evaluation.views
    )


def marked_photos(change: SceneChange) -> tuple[Comparison, ...]:
    """The used new photos with what changed in them, without any field's pictures."""
    return tuple(view for view in _photos(change, None, None) if view.photo is not None)


def _photos(
    change: SceneChange, before: Sequence[Rendering] | None, after: Sequence[Rendering] | None
) -> tuple[Comparison, ...]:
    out, used = [], 0
    for photo in change.photos:
        frame = photo.frame
        if frame is None:
            out.append(Comparison(photo.name, None))
            continue
        out.append(
            Comparison(
                name=photo.name,
                photo=frame_image(frame),
                before=None if before is None else before[used].rgb,
                after=None if after is None else after[used].rgb,
                depth_before=None if before is None else before[used].surface(),
                depth_after=None if after is None else after[used].surface(),
                mask_in=change.masks_in[used] if change.masks_in else None,
                mask_out=change.masks_out[used] if change.masks_out else None,
                unclear=change.unexplained[used] if change.unexplained else None,
                frame=frame,
            )
        )
        used += 1
    return tuple(out)
