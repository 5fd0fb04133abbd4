"""The helper NeRFacto field, whose colours depend on the photo's look besides (§4.1.2, §10.1).

It takes in the same space as the old field and has its shape, but no proposal networks: where to look is said by the
old field's, fine-tuned. Letters: S points, P photos, E numbers of a look.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from refield.field import kernels
from refield.field.encoding import Contraction, geometric_levels
from refield.field.kernels.reference import truncated_exp
from refield.field.nerfacto import NerfactoConfig
from refield.field.networks import HashNetwork, weight
from refield.field.stored import State


class HelperField(nn.Module):
    """Hash grid → density network → colour network, which is told the look of the photo that a ray belongs to.

    Without a photo it shows the mean of all looks, as nerfstudio renders.
    """

    def __init__(self, config: NerfactoConfig, contraction: Contraction, looks: tuple[int, int], seed: int = 0) -> None:
        """``looks``: P and E."""
        super().__init__()
        g = torch.Generator().manual_seed(seed)
        self.config, self.contraction = replace(config, proposals=()), contraction
        w, k = config.width, config.geometry_features
        levels = geometric_levels(config.coarsest, config.finest, config.levels)
        self.trunk = HashNetwork(levels, config.log2_table, (w, 1 + k), g)
        self.colour_in = weight(w, k + 16 + looks[1], g)
        self.colour_mid = weight(w, w, g)
        self.colour_out = weight(3, w, g)
        self.looks = nn.Parameter(torch.randn(*looks, generator=g))

    def density(self, x: Tensor) -> Tensor:
        """World points (..., 3) -> sigma (...,), per world unit."""
        return self._sigma(self.trunk(self.contraction(x.reshape(-1, 3)), slice(1))[:, 0]).reshape(x.shape[:-1])

    def forward(self, x: Tensor, d: Tensor, photo: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """World points and unit directions (S, 3), photos (S,) int64 -> sigma (S,), rgb (S, 3) in [0, 1]."""
        out = self.trunk(self.contraction(x))
        look = self.looks.mean(0).expand(len(x), -1) if photo is None else self.looks[photo]
        features = torch.cat([out[:, 1:], kernels.spherical_harmonics(d), look], -1)
        hidden = functional.relu(functional.linear(features, self.colour_in))
        hidden = functional.relu(functional.linear(hidden, self.colour_mid))
        return self._sigma(out[:, 0]), torch.sigmoid(functional.linear(hidden, self.colour_out))

    def _sigma(self, raw: Tensor) -> Tensor:
        return truncated_exp(raw) * (self.config.first_density / self.contraction.radius)

    def state(self) -> State:
        """Named tensors, and facts that JSON can hold; the space is the old field's."""
        tensors = {k: v.detach().contiguous() for k, v in self.state_dict().items()}
        return tensors, {"config": asdict(self.config), "looks": list(self.looks.shape)}

    @staticmethod
    def from_state(tensors: dict[str, Tensor], facts: dict[str, Any], contraction: Contraction) -> HelperField:
        """Inverse of :meth:`state`. Raises KeyError, TypeError or RuntimeError if something is missing or of another
        shape."""
        shape = dict(facts["config"]) | {"proposals": ()}
        photos, size = facts["looks"]
        helper = HelperField(NerfactoConfig(**shape), contraction, (int(photos), int(size)))
        helper.load_state_dict(tensors)
        return helper.eval().requires_grad_(False)
