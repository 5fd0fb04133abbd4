"""LPIPS: how different two pictures look to a network's features (Zhang et al. 2018, v0.1); lower is more alike.

The features are AlexNet's or VGG16's as torchvision names their weights, the weights of the channels those that were
learnt from people's judgements. Both come from a local folder: see docs/weights.md.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from refield.vision.similarity import boxed
from refield.vision.weights import WeightsError

Perceptual = Callable[[Tensor, Tensor], float]
"""Two pictures (H, W, 3) in [0, 1] -> how different they look"""
Backbone = Literal["alex", "vgg"]

_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of pictures in [-1, 1], per channel
_TAPS: dict[Backbone, tuple[int, ...]] = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}
_FIRST: dict[tuple[int, ...], Backbone] = {(64, 3, 11, 11): "alex", (64, 3, 3, 3): "vgg"}
_LEAST_SIDE = 32  # pixels; a smaller picture would vanish in the networks
_LIN = re.compile(r"(?:^|\.)lin([0-4])\.(?:model\.)?(?:1\.)?weight$")
_HASH = re.compile(r"-([0-9a-f]{8})\.pth$")  # how torchvision names its files: the beginning of their SHA-256
_REMEDY = "see docs/weights.md for the two files that are needed"


def alexnet_features() -> nn.Sequential:
    """The convolutions of AlexNet up to the last that is looked at."""
    widths, kernels = (3, 64, 192, 384, 256, 256), (11, 5, 3, 3, 3)
    layers: list[nn.Module] = []
    for i, kernel in enumerate(kernels):
        stride, padding = (4, 2) if i == 0 else (1, kernel // 2)
        layers += [nn.Conv2d(widths[i], widths[i + 1], kernel, stride, padding), nn.ReLU()]
        layers += [nn.MaxPool2d(3, 2)] if i < 2 else []
    return nn.Sequential(*layers)


def vgg16_features() -> nn.Sequential:
    """The convolutions of VGG16 up to the last that is looked at."""
    layers: list[nn.Module] = []
    before = 3
    for block, (width, count) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))):
        layers += [nn.MaxPool2d(2, 2)] if block else []
        for _ in range(count):
            layers += [nn.Conv2d(before, width, 3, 1, 1), nn.ReLU()]
            before = width
    return nn.Sequential(*layers)


FEATURES: dict[Backbone, Callable[[], nn.Sequential]] = {"alex": alexnet_features, "vgg": vgg16_features}
WIDTHS: dict[Backbone, tuple[int, ...]] = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}


class Lpips(nn.Module):
    """The distance itself. Call it with two pictures."""

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.backbone = backbone
        self.features = FEATURES[backbone]()
        self.lins = nn.ParameterList([torch.zeros(n) for n in WIDTHS[backbone]])
        self.eval().requires_grad_(False)

    def forward(self, image: Tensor, truth: Tensor) -> float:
        """(H, W, 3) in [0, 1] each -> the distance, 0 for equal pictures.

        Raises ValueError if they differ in size or are smaller than 32 pixels.
        """
        if image.shape != truth.shape or min(image.shape[:2]) < _LEAST_SIDE:
            what = f"{tuple(image.shape)} and {tuple(truth.shape)}"
            raise ValueError(f"LPIPS compares pictures of one size of at least {_LEAST_SIDE} pixels, not {what}")
        with torch.no_grad():
            maps = self._unit_maps(torch.stack([image, truth]).float().permute(0, 3, 1, 2))
            distances = [(m[0] - m[1]).square().mean((1, 2)) @ lin for m, lin in zip(maps, self.lins)]
        return float(torch.stack(distances).sum())

    def _unit_maps(self, pictures: Tensor) -> list[Tensor]:
        """(B, 3, H, W) in [0, 1] -> at each tap (B, C, h, w), of length 1 over the channels."""
        shift, scale = (torch.tensor(v).view(1, 3, 1, 1) for v in (_SHIFT, _SCALE))
        x, out = (2 * pictures - 1 - shift) / scale, []
        for i, layer in enumerate(self.features):
            x = layer(x)
            if i in _TAPS[self.backbone]:
                out.append(functional.normalize(x, dim=1, eps=1e-10))
        return out


def lpips_in_box(measure: Perceptual, image: Tensor, truth: Tensor, mask: Tensor, side: int = 256) -> float | None:
    """LPIPS of the tight bounding box of ``mask`` (H, W) bool, resized to ``side`` x ``side`` (§11.2).

    Pixels in the box that are outside the mask stay as they are. None if the mask has no pixel.
    """
    pair = boxed(image, truth, mask, side)
    return None if pair is None else measure(*pair)


def open_lpips(folder: Path, backbone: Backbone | None = None) -> Lpips:
    """LPIPS with the weights in a folder: ``*.safetensors`` and ``*.pth`` with a network and its channels' weights.

    Which is which is told by what they hold. ``backbone``: by default AlexNet where the folder has both.

    Raises:
        WeightsError: the folder or a part of the weights is missing, damaged or of another network.
    """
    networks, channels = _found(Path(folder))
    both = [b for b in FEATURES if b in networks and b in channels]
    wanted = backbone or next(iter(both), None)
    if wanted is None or wanted not in both:
        raise WeightsError(Path(folder), _missing(networks, channels, backbone), _REMEDY)
    model = Lpips(wanted)
    try:
        model.features.load_state_dict(_prefixed(networks[wanted], model.features))
    except (RuntimeError, KeyError) as error:
        what = f"the weights of {wanted} do not fit ({_line(error)})"
        raise WeightsError(Path(folder), what, "get the file again") from None
    for lin, weight in zip(model.lins, channels[wanted]):
        lin.copy_(weight.detach())
    damaged = [k for k, v in model.state_dict().items() if not torch.isfinite(v).all()]
    if damaged or any(bool((lin < 0).any()) for lin in model.lins):
        what = f"{damaged[0]} is not finite" if damaged else "the weights of the channels are partly negative"
        raise WeightsError(Path(folder), what, "get the files again")
    return model


Networks = dict[Backbone, Mapping[str, Tensor]]
Channels = dict[Backbone, list[Tensor]]


def _found(folder: Path) -> tuple[Networks, Channels]:
    """Everything in the folder that is a network's or its channels'."""
    if not folder.is_dir():
        raise WeightsError(folder, "is not a folder", _REMEDY)
    files = sorted(p for p in folder.iterdir() if p.suffix in (".safetensors", ".pth"))
    if not files:
        raise WeightsError(folder, "has no *.safetensors and no *.pth", _REMEDY)
    networks: Networks = {}
    channels: Channels = {}
    for path in files:
        state = _read(path)
        first = state.get("features.0.weight")
        kind = None if first is None else _FIRST.get(tuple(first.shape))
        if kind is not None:
            networks[kind] = state
        lins = {m[1]: v.flatten() for k, v in state.items() if (m := _LIN.search(k))}
        widths = tuple(len(lins[i]) for i in sorted(lins))
        channels |= {b: [lins[i] for i in sorted(lins)] for b, w in WIDTHS.items() if w == widths}
    return networks, channels


def _read(path: Path) -> dict[str, Tensor]:
    """Named tensors and nothing else; no code of the file is run."""
    try:
        if path.suffix == ".safetensors":
            return load_file(str(path))
        state = _read_pth(path)
    except (OSError, RuntimeError, ValueError, KeyError, SafetensorError) as error:
        raise WeightsError(path, f"cannot be read ({_line(error)})", "get the file again") from None
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise WeightsError(path, "holds something else than named tensors", "give a state dict")
    return {str(k): v for k, v in state.items()}


def _read_pth(path: Path) -> object:
    version = tuple(int(n) for n in torch.__version__.split("+")[0].split(".")[:2])
    if version < (2, 10):  # ways round weights_only were found in older ones
        raise WeightsError(path, f"is not read by torch {torch.__version__}", "convert it to safetensors")
    named = _HASH.search(path.name)
    if named and not hashlib.sha256(path.read_bytes()).hexdigest().startswith(named[1]):
        raise WeightsError(path, "has another checksum than its name says", "get the file again")
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever the restricted reader makes of a stranger's file
        raise ValueError(_line(error)) from None


def _prefixed(state: Mapping[str, Tensor], features: nn.Sequential) -> dict[str, Tensor]:
    """The features' part of a whole network's state."""
    return {name: state[f"features.{name}"] for name in features.state_dict()}


def _missing(networks: Networks, channels: Channels, backbone: Backbone | None) -> str:
    names = {"alex": "AlexNet", "vgg": "VGG16"}
    wanted = [backbone] if backbone else list(FEATURES)
    have = [f"the network of {names[b]}" for b in networks]
    have += [f"the channels' weights for {names[b]}" for b in channels]
    return f"has not both parts for {' or '.join(names[b] for b in wanted)} (found: {', '.join(have) or 'neither'})"


def _line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:160]
