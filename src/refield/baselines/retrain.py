"""Re-training from scratch with masks: what one would do without an update (§5.2)."""

from __future__ import annotations

from refield.baselines.curve import Curve
from refield.baselines.material import material
from refield.field.fit import FitConfig, fit_field
from refield.field.photos import Since
from refield.field.radiance import HashField
from refield.scene.capture import Capture
from refield.scene.change import SceneChange

DEFAULTS = FitConfig()


def retrain(
    capture: Capture,
    change: SceneChange,
    config: FitConfig = DEFAULTS,
    curve: Curve | None = None,
    since: Since | None = None,
) -> HashField:
    """A fresh field of the changed scene, from the old photos where they still hold and the new photos.

    Place and shape of the field are those that the old photos alone gave it; so is what it stops on, the held-out
    photos' pixels that still hold. ``curve`` is told the field during training and at its end. ``since``: what to
    learn from, in place of `material`.

    Raises:
        ValueError: the change leaves no pixel to train on.
        NonFiniteError: as of `fit_field`.
    """
    return trained(capture, change, config, curve, None, since)


def trained(
    capture: Capture,
    change: SceneChange,
    config: FitConfig,
    curve: Curve | None,
    start: HashField | None,
    since: Since | None = None,
) -> HashField:
    """A fit to the changed scene, from ``start`` or from random weights; ``curve`` also hears the end."""
    taken = [0]

    def on_step(step: int, field: HashField) -> None:
        taken[0] = step
        if curve is not None:
            curve(step, field)

    known = material(capture, change) if since is None else since
    field = fit_field(capture, config, since=known, start=start, on_step=on_step)
    if curve is not None:
        curve.look(taken[0], field)
    return field
