"""Direct fine-tuning: the old field's own weights trained on (§4.1.3, Fig. 4)."""

from __future__ import annotations

from refield.baselines.curve import Curve
from refield.baselines.retrain import DEFAULTS, trained
from refield.field.fit import FitConfig
from refield.field.photos import Since
from refield.field.radiance import HashField
from refield.scene.capture import Capture
from refield.scene.change import SceneChange


def finetune(
    capture: Capture,
    field: HashField,
    change: SceneChange,
    config: FitConfig = DEFAULTS,
    curve: Curve | None = None,
    since: Since | None = None,
) -> HashField:
    """The old field trained on with the data and the settings of `retrain.retrain`; ``field`` itself is not changed.

    Which cells of it are empty is found anew, since something may have come to where nothing was.

    Raises:
        ValueError: the change leaves no pixel to train on.
        NonFiniteError: as of `fit_field`.
    """
    return trained(capture, change, config, curve, field, since)
