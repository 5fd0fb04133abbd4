"""LPIPS with random weights: what it computes, and what is said of weights that are no use."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from refield.vision.perceptual import FEATURES, WIDTHS, Backbone, Lpips, lpips_in_box, open_lpips
from refield.vision.weights import WeightsError


def filled(backbone: Backbone, seed: int = 0) -> Lpips:
    g = torch.Generator().manual_seed(seed)
    model = Lpips(backbone)
    for layer in model.features:
        if isinstance(layer, nn.Conv2d):
            layer.weight.copy_(torch.randn(layer.weight.shape, generator=g) * (2 / layer.weight[0].numel()) ** 0.5)
            layer.bias.copy_(torch.randn(layer.bias.shape, generator=g) * 0.1)
    for lin in model.lins:
        lin.copy_(torch.rand(lin.shape, generator=g))
    return model


def pictures(count: int, h: int = 48, w: int = 40) -> list[Tensor]:
    g = torch.Generator().manual_seed(1)
    return [torch.rand(h, w, 3, generator=g) for _ in range(count)]


def network_of(model: Lpips) -> dict[str, Tensor]:
    """As torchvision calls them, with a classifier that is not needed."""
    state = {f"features.{k}": v.clone() for k, v in model.features.state_dict().items()}
    return state | {"classifier.1.weight": torch.zeros(2, 2)}


def channels_of(model: Lpips) -> dict[str, Tensor]:
    """As the published file calls them."""
    return {f"lin{i}.model.1.weight": lin.detach().clone().view(1, -1, 1, 1) for i, lin in enumerate(model.lins)}


@pytest.mark.parametrize("backbone", list(FEATURES))
def test_it_is_a_distance(backbone: Backbone) -> None:
    model, (a, b) = filled(backbone), pictures(2)
    assert model(a, a) == 0
    assert model(a, b) == pytest.approx(model(b, a)) and model(a, b) > 0.01
    assert model(a, 0.9 * a + 0.1 * b) < model(a, b)


@pytest.mark.parametrize("backbone", list(FEATURES))
def test_the_layers_are_those_of_the_published_networks(backbone: Backbone) -> None:
    shapes = {k: tuple(v.shape) for k, v in network_of(Lpips(backbone)).items() if k.endswith("weight")}
    if backbone == "alex":
        assert shapes["features.0.weight"] == (64, 3, 11, 11) and shapes["features.3.weight"] == (192, 64, 5, 5)
        assert [shapes[f"features.{i}.weight"][0] for i in (6, 8, 10)] == [384, 256, 256]
    else:
        at = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
        widths = [64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512]
        assert [shapes[f"features.{i}.weight"][0] for i in at] == widths
    maps = filled(backbone)._unit_maps(torch.rand(1, 3, 64, 64))
    assert tuple(m.shape[1] for m in maps) == WIDTHS[backbone]
    assert [m.shape[-1] for m in maps] == ([15, 7, 3, 3, 3] if backbone == "alex" else [64, 32, 16, 8, 4])


def test_the_sum_written_out() -> None:
    """Against the paper's Eq. 1 with loops, on the first layer alone."""
    model, (a, b) = filled("alex"), pictures(2)
    for lin in list(model.lins)[1:]:
        lin.zero_()
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    maps = []
    for p in (a, b):
        x = ((2 * p - 1 - shift) / scale).permute(2, 0, 1)
        maps.append(model.features[0](x).clamp_min(0))
    total = 0.0
    for y in range(maps[0].shape[1]):
        for x in range(maps[0].shape[2]):
            u, v = (m[:, y, x] / m[:, y, x].norm().clamp_min(1e-10) for m in maps)
            total += float((model.lins[0] * (u - v) ** 2).sum())
    assert model(a, b) == pytest.approx(total / maps[0][0].numel(), rel=1e-4)


def test_only_the_masks_box_counts() -> None:
    model, (a, b) = filled("alex"), pictures(2)
    mask = torch.zeros(48, 40, dtype=torch.bool)
    mask[10:20, 5:30] = True
    outside = torch.where(mask[..., None], a, b)
    assert lpips_in_box(model, outside, a, mask, 64) == 0
    assert lpips_in_box(model, b, a, mask, 64) > 0.01
    assert lpips_in_box(model, b, a, torch.zeros_like(mask), 64) is None


def test_pictures_that_cannot_be_compared() -> None:
    model = filled("alex")
    for a, b in ((torch.rand(40, 40, 3), torch.rand(40, 41, 3)), (torch.rand(16, 40, 3), torch.rand(16, 40, 3))):
        with pytest.raises(ValueError, match="of one size of at least 32 pixels"):
            model(a, b)


def test_weights_are_found_by_what_they_hold(tmp_path: Path) -> None:
    model, (a, b) = filled("alex"), pictures(2)
    save_file(network_of(model), str(tmp_path / "x.safetensors"))
    save_file(channels_of(model), str(tmp_path / "y.safetensors"))
    assert open_lpips(tmp_path)(a, b) == model(a, b)
    with pytest.raises(WeightsError, match=r"not both parts for VGG16.*found: the network of AlexNet"):
        open_lpips(tmp_path, "vgg")


def test_torchvisions_own_file(tmp_path: Path) -> None:
    model, (a, b) = filled("alex"), pictures(2)
    torch.save(network_of(model), tmp_path / "net")
    digest = hashlib.sha256((tmp_path / "net").read_bytes()).hexdigest()
    (tmp_path / "net").rename(tmp_path / f"alexnet-owt-{digest[:8]}.pth")
    old_format = {"_use_new_zipfile_serialization": False}  # in which the authors published theirs
    torch.save({k: nn.Parameter(v) for k, v in channels_of(model).items()}, tmp_path / "alex.pth", **old_format)
    assert open_lpips(tmp_path)(a, b) == model(a, b)
    next(tmp_path.glob("alexnet*")).rename(tmp_path / "alexnet-owt-00000000.pth")
    with pytest.raises(WeightsError, match="another checksum than its name says"):
        open_lpips(tmp_path)


class Code:
    """What a hostile file would hold."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return print, ("run",)


def test_nothing_in_a_file_is_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    torch.save({"features.0.weight": Code()}, tmp_path / "bad.pth")
    with pytest.raises(WeightsError, match=r"bad\.pth: cannot be read"):
        open_lpips(tmp_path)
    assert "run" not in capsys.readouterr().out


def test_faults_are_named(tmp_path: Path) -> None:
    def said(folder: Path) -> str:
        with pytest.raises(WeightsError) as caught:
            open_lpips(folder)
        return str(caught.value)

    assert "is not a folder" in said(tmp_path / "none")
    assert "no *.safetensors and no *.pth" in said(tmp_path)
    model = filled("alex")
    save_file(network_of(model), str(tmp_path / "a.safetensors"))
    assert "found: the network of AlexNet)" in said(tmp_path) and "docs/weights.md" in said(tmp_path)
    channels = channels_of(model)
    save_file(channels | {"lin2.model.1.weight": -channels["lin2.model.1.weight"]}, str(tmp_path / "b.safetensors"))
    assert "partly negative" in said(tmp_path)
    save_file(channels, str(tmp_path / "b.safetensors"))
    broken = network_of(model)
    broken["features.3.weight"][0, 0, 0, 0] = float("nan")
    save_file(broken, str(tmp_path / "a.safetensors"))
    assert "features.3.weight is not finite" in said(tmp_path)
    del broken["features.6.weight"]
    save_file(broken, str(tmp_path / "a.safetensors"))
    assert "do not fit" in said(tmp_path)
    (tmp_path / "a.safetensors").write_bytes(b"nothing")
    assert "a.safetensors: cannot be read" in said(tmp_path)
