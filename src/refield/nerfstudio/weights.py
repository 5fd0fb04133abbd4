"""The weights of a ``nerfacto`` checkpoint → `NerfstudioField`.

What nerfstudio does at evaluation is done once: the appearance embedding is one vector for every view, so its part of
the colour network's first layer is a bias.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from refield.field.nerfstudio import (
    GridShape,
    NerfstudioConfig,
    NerfstudioField,
    NetworkShape,
    looking_everywhere,
)
from refield.nerfstudio.placing import Placing
from refield.nerfstudio.tables import GridSettings, features_in, laid_out, torch_levels
from refield.nerfstudio.tiny_cuda import Layers, grid_levels, grid_size, network_layers
from refield.scene.errors import InputError

State = Mapping[str, Tensor]
_FLIPPED = (1, 3, 5, 7, 9, 11, 13, 15)  # spherical harmonics of the other sign in nerfstudio's torch code
_HARMONICS = 16
_GEOMETRY = 15  # features that the trunk hands on; no setting
_PACKED = "tcnn_encoding.params"  # how tiny-cuda-nn's weights are named
_PACKED_HEAD = f"field.mlp_head.{_PACKED}"


@dataclass(frozen=True)
class Network:
    """A hash grid with a network behind it, as tensors and as a shape."""

    tables: Tensor
    layers: Layers
    grid: GridShape

    @property
    def shape(self) -> NetworkShape:
        return NetworkShape(self.grid, tuple(len(bias) for _, bias in self.layers))


def field_of(
    state: State, model: Mapping[str, Any], placing: Placing, where: Path, white: bool = True
) -> NerfstudioField:
    """The field, looking everywhere.

    Args:
        state: the model's tensors by name.
        model: its settings, as config.yml has them.
        placing: how nerfstudio's axes lie in the world.
        where: the checkpoint, for messages.
        white: a white background is shown; else it is black, as what is transparent in our photos.

    Raises:
        InputError: the tensors are not what the settings say, in nerfstudio's or tiny-cuda-nn's layout.
    """
    try:
        return _field(state, model, placing, white)
    except (KeyError, IndexError, ValueError, TypeError, RuntimeError) as error:
        said = f"there is no {error}" if isinstance(error, KeyError) else str(error).splitlines()[0]
        raise InputError(
            where, f"is not the nerfacto that config.yml describes ({said})", "is it of this run?"
        ) from None


def _field(state: State, model: Mapping[str, Any], placing: Placing, white: bool) -> NerfstudioField:
    trunk = _trunk(state, model)
    colour = _colour(state, model, trunk.layers[-1][0].shape[0] - 1)
    proposals = _proposals(state, model)
    box = None
    if model.get("disable_scene_contraction", False):
        box = tuple(float(v) for v in state["field.aabb"].reshape(6))
    counts = (*model["num_proposal_samples_per_ray"][: len(proposals)], model["num_nerf_samples_per_ray"])
    config = NerfstudioConfig(
        trunk.shape,
        tuple(len(bias) for _, bias in colour),
        tuple(p.shape for p in proposals),
        tuple(int(c) for c in counts),
        radius=placing.radius,
        far=float(model["far_plane"]),
        even=model.get("proposal_initial_sampler", "piecewise") == "uniform",
        first_density=float(model.get("average_init_density", 1.0)),
        box=box,
        halved=_PACKED_HEAD not in state,
        sky=_sky(model.get("background_color", "last_sample"), white),
    )
    field = NerfstudioField(config, looking_everywhere(placing.centre.float(), config))
    tensors = {"centre": placing.centre.float(), "turn": placing.turn.float()}
    tensors |= _named("trunk.", trunk.layers, trunk.tables) | _named("colour.", colour)
    for i, p in enumerate(proposals):
        tensors |= _named(f"proposals.{i}.", p.layers, p.tables)
    if not all(bool(t.isfinite().all()) for t in tensors.values()):
        raise ValueError("a weight is not finite")
    field.load_state_dict(tensors)
    return field.eval().requires_grad_(False)


def _trunk(state: State, model: Mapping[str, Any]) -> Network:
    settings = GridSettings(
        model["num_levels"],
        model.get("base_res", 16),
        model["max_res"],
        model["log2_hashmap_size"],
        model.get("features_per_level", 2),
    )
    widths = (model["hidden_dim"], 1 + _GEOMETRY)
    return _network(state, ("field.mlp_base.model.", "field.mlp_base."), settings, widths)


def _proposals(state: State, model: Mapping[str, Any]) -> list[Network]:
    """In the order in which they are asked; one may be asked more than once."""
    out, told = [], model["proposal_net_args_list"]
    for i in range(model["num_proposal_iterations"]):
        which = 0 if model.get("use_same_proposal_network", False) else i
        said = told[min(which, len(told) - 1)]
        settings = GridSettings(
            said.get("num_levels", 8),
            said.get("base_res", 16),
            said.get("max_res", 1024),
            said.get("log2_hashmap_size", 18),
            said.get("features_per_level", 2),
        )
        name = f"proposal_networks.{which}."
        if said.get("use_linear", False):
            layers = [(state[f"{name}linear.weight"].float(), state[f"{name}linear.bias"].float())]
            out.append(_behind_grid(state, f"{name}encoding.", layers, settings))
        else:
            widths = (*[said.get("hidden_dim", 64)] * (said.get("num_layers", 2) - 1), 1)
            out.append(_network(state, (f"{name}mlp_base.",), settings, widths))
    return out


def _network(state: State, prefixes: tuple[str, ...], settings: GridSettings, widths: tuple[int, ...]) -> Network:
    """The hash grid and the layers, of these ``widths``, under the first of the prefixes that is there; it changed with
    nerfstudio 1.0."""
    inputs = settings.num_levels * settings.features_per_level
    for prefix in prefixes:
        if f"{prefix}params" in state:  # both in one, the network first
            packed, size = state[f"{prefix}params"], grid_size(settings)
            layers = network_layers(packed[: max(len(packed) - size, 0)], (inputs, *widths), ones=False)
            return _laid_out(packed[len(packed) - size :], layers, settings)
        if f"{prefix}1.{_PACKED}" in state:
            layers = network_layers(state[f"{prefix}1.{_PACKED}"], (inputs, *widths), ones=True)
            return _behind_grid(state, f"{prefix}0.", layers, settings)
        if f"{prefix}1.layers.0.weight" in state:
            return _behind_grid(state, f"{prefix}0.", _layers(state, f"{prefix}1."), settings)
    raise KeyError(f"{prefixes[0]}…")


def _behind_grid(state: State, prefix: str, layers: Layers, settings: GridSettings) -> Network:
    packed = state.get(f"{prefix}{_PACKED}")
    return _laid_out(state[f"{prefix}hash_table"] if packed is None else packed, layers, settings)


def _laid_out(table: Tensor, layers: Layers, settings: GridSettings) -> Network:
    """``table`` is (entries, features), or flat where tiny-cuda-nn has packed it."""
    levels, scales = grid_levels(table, settings) if table.ndim == 1 else (torch_levels(table, settings), ())
    tables, grid = laid_out(levels, settings.log2_hashmap_size, scales)
    (weight, bias), *rest = layers
    return Network(tables, [(features_in(weight, settings), bias), *rest], grid)


def _layers(state: State, prefix: str) -> Layers:
    """``layers.0``, ``layers.1``, … as far as there are any."""
    out: Layers = []
    while f"{prefix}layers.{len(out)}.weight" in state or not out:
        name = f"{prefix}layers.{len(out)}"
        out.append((state[f"{name}.weight"].float(), state[f"{name}.bias"].float()))
    return out


def _colour(state: State, model: Mapping[str, Any], features: int) -> Layers:
    """Behind 16 harmonics in our signs and the features; the mean embedding has become a bias."""
    table, known = state.get("field.embedding_appearance.embedding.weight"), _HARMONICS + features
    inputs, signs = known + (0 if table is None else table.shape[1]), torch.ones(_HARMONICS)
    if _PACKED_HEAD in state:
        width = model.get("hidden_dim_color", 64)
        (weight, bias), *rest = network_layers(state[_PACKED_HEAD], (inputs, width, width, 3), ones=True)
    else:
        (weight, bias), *rest = _layers(state, "field.mlp_head.")
        signs[list(_FLIPPED)] = -1
    if weight.shape[1] != inputs:
        raise ValueError(f"the colour network takes {weight.shape[1]} numbers, not {inputs}")
    if table is not None and model.get("use_average_appearance_embedding", True):
        bias = bias + weight[:, known:] @ table.float().mean(0)
    return [(torch.cat([weight[:, :_HARMONICS] * signs, weight[:, _HARMONICS:known]], 1), bias), *rest]


def _sky(background: str, white: bool) -> tuple[float, float, float] | bool:
    if background == "white":
        return (1.0, 1.0, 1.0) if white else False
    return background == "last_sample"


def _named(prefix: str, layers: Layers, tables: Tensor | None = None) -> dict[str, Tensor]:
    """The tensors of a network under the names of our module."""
    out = {} if tables is None else {f"{prefix}tables": tables}
    inner = prefix if tables is None else f"{prefix}layers."
    for i, (weight, bias) in enumerate(layers):
        out |= {f"{inner}{i}.weight": weight, f"{inner}{i}.bias": bias}
    return out
