"""Folders as nerfstudio's trainer leaves them, with random weights, and what nerfstudio would show of them.

The second is written from what its documentation and tiny-cuda-nn's say, point by point in double precision, and
shares nothing with our own code.
"""

from __future__ import annotations

import json
from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from refield.scene.capture import Capture
from refield.scene.pose import exp
from refield.scene.transforms_json import load_transforms
from tests.captures import write_capture

PHOTOS, RADIUS = 13, 2.5
APPLIED = [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
LEVELS, BASE, FINEST, TABLE, WIDTH, EMBEDDING = 4, 4, 50, 9, 16, 6
PROPOSALS = ((3, 4, 16, 9), (3, 4, 24, 8))  # levels, coarsest, finest, log2 of the table
"""tiny-cuda-nn's second level of the first just fits its table: 8 vertices a side, 512 rows"""
COUNTS = (24, 12, 10)

CONFIG = """\
!!python/object:nerfstudio.engine.trainer.TrainerConfig
_target: !!python/name:nerfstudio.engine.trainer.Trainer ''
data: &id001 !!python/object/apply:pathlib.PosixPath
- {data}
logging: !!python/object:nerfstudio.configs.base_config.LoggingConfig
  stats_to_track: !!python/tuple
  - !!python/object/apply:nerfstudio.utils.writer.EventName
    - Train Iter (time)
  relative_log_dir: !!python/object/apply:pathlib.PosixPath []
method_name: {method}
optimizers:
  fields:
    optimizer: !!python/object:nerfstudio.engine.optimizers.AdamOptimizerConfig
      _target: &id002 !!python/name:torch.optim.adam.Adam ''
      lr: 0.01
pipeline: !!python/object:nerfstudio.pipelines.base_pipeline.VanillaPipelineConfig
  _target: !!python/name:nerfstudio.pipelines.base_pipeline.VanillaPipeline ''
  datamanager: !!python/object:nerfstudio.data.datamanagers.parallel_datamanager.ParallelDataManagerConfig
    _target: !!python/object/apply:nerfstudio.data.datamanagers.parallel_datamanager.ParallelDataManager []
    data: *id001
    dataparser: !!python/object:nerfstudio.data.dataparsers.nerfstudio_dataparser.{parser}
      data: *id001
      eval_mode: fraction
      train_split_fraction: 0.9
  model: !!python/object:nerfstudio.models.{method}.Config
    _target: !!python/name:nerfstudio.models.{method}.{model} ''
    average_init_density: 0.01
    background_color: {background}
    base_res: 4
    camera_optimizer: !!python/object:nerfstudio.cameras.camera_optimizers.CameraOptimizerConfig
      mode: SO3xR3
    disable_scene_contraction: false
    far_plane: 1000.0
    features_per_level: 2
    hidden_dim: 16
    hidden_dim_color: 16
    implementation: tcnn
    log2_hashmap_size: 9
    max_res: 50
    num_levels: 4
    num_nerf_samples_per_ray: 10
    num_proposal_iterations: 2
    num_proposal_samples_per_ray: !!python/tuple
    - 24
    - 12
    proposal_initial_sampler: piecewise
    proposal_net_args_list:
    - {{base_res: 4, hidden_dim: 16, log2_hashmap_size: 9, max_res: 16, num_levels: 3, use_linear: false}}
    - {{base_res: 4, hidden_dim: 16, log2_hashmap_size: 8, max_res: 24, num_levels: 3, use_linear: true}}
    use_average_appearance_embedding: true
relative_model_dir: !!python/object/apply:pathlib.PosixPath
- nerfstudio_models
timestamp: 2026-11-23_120000
"""


@dataclass(frozen=True)
class Written:
    """A run that has been written."""

    folder: Path
    capture: Capture
    """as the transforms.json says"""
    state: dict[str, Tensor]
    """the model's tensors"""
    run_from_world: np.ndarray
    """(4, 4), a similarity"""


def write_run(root: Path, *, packed: bool = False, legacy: bool = False, **config: str) -> Written:
    """``root/photos`` and ``root/outputs/photos/nerfacto/now``: of nerfstudio's torch implementation, of version 0.3
    (``legacy``), or of tiny-cuda-nn."""
    capture = _write_photos(root / "photos")
    folder = root / "outputs" / "photos" / "nerfacto" / "now"
    (folder / "nerfstudio_models").mkdir(parents=True)
    names = {"data": "photos", "method": "nerfacto", "model": "NerfactoModel", "background": "last_sample"}
    (folder / "config.yml").write_text(CONFIG.format(**{**names, "parser": "NerfstudioDataParserConfig", **config}))
    state = packed_state() if packed else torch_state(legacy=legacy)
    write_checkpoint(folder / "nerfstudio_models" / "step-000000200.ckpt", state)
    write_checkpoint(folder / "nerfstudio_models" / "step-000000100.ckpt", {k: v * 0 for k, v in state.items()})
    return Written(folder, capture, state, _write_transform(folder, capture))


def _write_photos(folder: Path) -> Capture:
    """The ring of cameras, in a world that is turned, shifted and scaled."""
    write_capture(folder, PHOTOS)
    path = folder / "transforms.json"
    told, move = json.loads(path.read_text()), exp(torch.tensor([5.0, -3.0, 2.0, 0.4, -0.7, 0.3]).double())
    for frame in told["frames"]:
        pose = torch.tensor(frame["transform_matrix"]).double()
        pose[:3, 3] *= RADIUS
        frame["transform_matrix"] = (move @ pose).tolist()
    path.write_text(json.dumps({**told, "applied_transform": APPLIED}))
    return load_transforms(folder)


def _write_transform(folder: Path, capture: Capture) -> np.ndarray:
    """Centred on the cameras, turned somehow, the furthest coordinate 1; told for the axes before APPLIED."""
    centre = torch.stack([f.centre for f in capture.frames]).mean(0)
    turn = exp(torch.tensor([0.0, 0, 0, -0.2, 0.9, 0.5]).double())
    turn[:3, 3] = -turn[:3, :3] @ centre
    applied = np.vstack([np.array(APPLIED), [0, 0, 0, 1]])
    at = np.stack([(turn @ torch.cat([f.centre, torch.ones(1).double()]))[:3].numpy() for f in capture.frames])
    scale = 1 / np.abs(at).max()
    told = {"transform": (turn.numpy() @ applied)[:3].tolist(), "scale": float(scale)}
    (folder / "dataparser_transforms.json").write_text(json.dumps(told))
    return np.diag([scale, scale, scale, 1]) @ turn.numpy()


def write_checkpoint(path: Path, state: dict[str, Tensor], **more: object) -> None:
    """As Trainer.save_checkpoint: learning rates are numpy scalars; of other networks there are weights, too."""
    pipeline = OrderedDict({f"_model.{name}": tensor for name, tensor in state.items()})
    pipeline["_model.lpips.net.slice1.0.weight"] = torch.zeros(4)
    rate = {"_last_lr": [np.float64(0.0098)], "lr_lambdas": [None], "last_epoch": 200}
    adam = {
        "state": {0: {"step": torch.tensor(1.0)}},
        "param_groups": [{"lr": np.exp(np.float64(-4.6)), "params": [0]}],
    }
    told = {"step": 200, "pipeline": pipeline, "optimizers": {"fields": adam}, "schedulers": {"fields": rate}}
    torch.save({**told, "scalers": {}, **more}, path)


def torch_state(*, legacy: bool = False) -> dict[str, Tensor]:
    """Names and shapes of nerfstudio's torch implementation."""
    g = torch.Generator().manual_seed(0)
    state: dict[str, Tensor] = {}

    def linear(name: str, rows: int, columns: int) -> None:
        state[f"{name}.weight"] = torch.randn(rows, columns, generator=g) * columns**-0.5
        state[f"{name}.bias"] = torch.randn(rows, generator=g) * 0.3

    def table(name: str, levels: int, log2: int) -> None:
        state[f"{name}.hash_table"] = torch.randn(levels << log2, 2, generator=g)

    grid, mlp = ("0", "1") if legacy else ("model.0", "model.1")
    table(f"field.mlp_base.{grid}", LEVELS, TABLE)
    linear(f"field.mlp_base.{mlp}.layers.0", WIDTH, 2 * LEVELS)
    linear(f"field.mlp_base.{mlp}.layers.1", 16, WIDTH)
    state[f"field.mlp_base.{mlp}.layers.1.weight"][0] *= 2
    state[f"field.mlp_base.{mlp}.layers.1.bias"][0] += 0.5  # so that something is to be seen, but not everywhere
    for i, columns in enumerate((31 + EMBEDDING, WIDTH, WIDTH)):
        linear(f"field.mlp_head.layers.{i}", 3 if i == 2 else WIDTH, columns)
    table("proposal_networks.0.mlp_base.0", 3, 9)
    linear("proposal_networks.0.mlp_base.1.layers.0", WIDTH, 6)
    linear("proposal_networks.0.mlp_base.1.layers.1", 1, WIDTH)
    table("proposal_networks.1.encoding", 3, 8)
    linear("proposal_networks.1.linear", 1, 6)
    state["field.embedding_appearance.embedding.weight"] = torch.randn(_trained(), EMBEDDING, generator=g)
    state["camera_optimizer.pose_adjustment"] = torch.randn(_trained(), 6, generator=g) * 0.01
    state["field.aabb"] = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])
    state["device_indicator_param"] = torch.empty(0)
    return state


def packed_state() -> dict[str, Tensor]:
    """Names and sizes of tiny-cuda-nn's: padded to 16, but the second proposal's network is torch's."""
    g = torch.Generator().manual_seed(0)

    def flat(count: int) -> Tensor:
        return torch.randn(count, generator=g) * 0.5

    base = torch.cat([flat(16 * 16 + 16 * 16), 2 * flat(2 * sum(_rows(LEVELS, BASE, FINEST, TABLE)))])
    state = {
        "field.mlp_base.model.params": base,
        "field.mlp_head.tcnn_encoding.params": flat(16 * 48 + 16 * 16 + 16 * 16),
        "field.direction_encoding.tcnn_encoding.params": torch.empty(0),
        "proposal_networks.0.mlp_base.0.tcnn_encoding.params": 2 * flat(2 * sum(_rows(*PROPOSALS[0]))),
        "proposal_networks.0.mlp_base.1.tcnn_encoding.params": flat(16 * 16 + 16 * 16),
        "proposal_networks.1.encoding.tcnn_encoding.params": 2 * flat(2 * sum(_rows(*PROPOSALS[1]))),
    }
    kept = ("proposal_networks.1.linear", "field.embedding", "field.aabb", "camera_optimizer")
    return state | {k: v for k, v in torch_state().items() if k.startswith(kept)}


def _trained() -> int:
    return int(np.ceil(0.9 * PHOTOS))


def _scales(levels: int, base: int, finest: int) -> list[float]:
    growth = (finest / base) ** (1 / (levels - 1))
    return [base * growth**i - 1 for i in range(levels)]


def _rows(levels: int, base: int, finest: int, log2: int) -> list[int]:
    return [min(-(-((int(np.ceil(s)) + 1) ** 3) // 8) * 8, 1 << log2) for s in _scales(levels, base, finest)]


def hashed(corner: tuple[int, int, int], size: int) -> int:
    x, y, z = corner
    return (x ^ (y * 2654435761 % 2**32) ^ (z * 805459861 % 2**32)) % size


class Theirs:
    """What nerfstudio shows of a state, in its own axes; all in double precision, one point or ray at a time."""

    def __init__(self, state: dict[str, Tensor]) -> None:
        self.state = {k: v.double().numpy() for k, v in state.items()}
        self.packed = any(k.endswith("params") and len(v) for k, v in self.state.items())
        self.model = "model." if any("mlp_base.model" in k for k in self.state) else ""

    def density(self, x: np.ndarray) -> float:
        """Of the field, per run unit."""
        return float(0.01 * np.exp(self._trunk(x)[0]))

    def colour(self, x: np.ndarray, d: np.ndarray) -> np.ndarray:
        """At evaluation."""
        # tiny-cuda-nn takes directions in [0, 1] and maps them back, nerfstudio's torch code does not
        way, sign = (d, -1) if self.packed else ((d + 1) / 2, 1)
        mean = self.state["field.embedding_appearance.embedding.weight"].mean(0)
        entering = np.concatenate([_harmonics(way, sign), self._trunk(x)[1:16], mean])
        if self.packed:
            out = _packed_mlp(self.state["field.mlp_head.tcnn_encoding.params"], entering, 16, 2, 1.0)
        else:
            out = self._mlp("field.mlp_head.", entering)
        return 1 / (1 + np.exp(-out[:3]))

    def proposed(self, which: int, x: np.ndarray) -> float:
        """Density that a proposal network says."""
        levels, base, finest, log2 = PROPOSALS[which]
        name = f"proposal_networks.{which}."
        grid = f"{name}mlp_base.0." if which == 0 else f"{name}encoding."
        features = self._features(grid, _unit(x), levels, base, finest, log2)
        if which == 1:
            raw = self.state[f"{name}linear.weight"] @ features + self.state[f"{name}linear.bias"]
        elif self.packed:
            raw = _packed_mlp(self.state[f"{name}mlp_base.1.tcnn_encoding.params"], features, 16, 1, 1.0)
        else:
            raw = self._mlp(f"{name}mlp_base.1.", features)
        return float(0.01 * np.exp(raw[0]))

    def pixel(self, origin: np.ndarray, d: np.ndarray) -> np.ndarray:
        """The colour of a ray: proposals narrow down 24 intervals; what is left is the last sample's."""
        edges = np.linspace(0, 1, COUNTS[0] + 1)
        for which, following in enumerate(COUNTS[1:]):
            w = _weights([self.proposed(which, x) for x in _middles(origin, d, edges)], edges) + 0.01
            cdf = np.concatenate([[0], np.cumsum(w) / w.sum()])
            edges = np.interp((np.arange(following + 1) + 0.5) / (following + 1), cdf, edges)
        at = _middles(origin, d, edges)
        w, rgb = _weights([self.density(x) for x in at], edges), np.stack([self.colour(x, d) for x in at])
        return (w[:, None] * rgb).sum(0) + (1 - w.sum()) * rgb[-1]

    def _trunk(self, x: np.ndarray) -> np.ndarray:
        if self.packed:
            packed = self.state["field.mlp_base.model.params"]
            size = 2 * sum(_rows(LEVELS, BASE, FINEST, TABLE))
            features = _staggered(packed[-size:], _unit(x), LEVELS, BASE, FINEST, TABLE)
            return _packed_mlp(packed[:-size], features, 16, 1, 0.0)
        features = self._features(f"field.mlp_base.{self.model}0.", _unit(x), LEVELS, BASE, FINEST, TABLE)
        return self._mlp(f"field.mlp_base.{self.model}1.", features)

    def _features(self, name: str, unit: np.ndarray, levels: int, base: int, finest: int, log2: int) -> np.ndarray:
        if self.packed:
            return _staggered(self.state[f"{name}tcnn_encoding.params"], unit, levels, base, finest, log2)
        table, out = self.state[f"{name}hash_table"], []
        growth = np.exp((np.log(finest) - np.log(base)) / (levels - 1))
        for i, cells in enumerate(torch.floor(base * growth ** torch.arange(levels)).tolist()):  # in single precision
            rows = table[i << log2 : (i + 1) << log2]
            out.append(trilinear(unit * cells, lambda c, rows=rows: rows[hashed(c, len(rows))]))
        return np.concatenate(out)

    def _mlp(self, name: str, x: np.ndarray) -> np.ndarray:
        i = 0
        while f"{name}layers.{i}.weight" in self.state:
            x = np.maximum(x, 0) if i else x
            x = self.state[f"{name}layers.{i}.weight"] @ x + self.state[f"{name}layers.{i}.bias"]
            i += 1
        return x


def _packed_mlp(packed: np.ndarray, x: np.ndarray, width: int, hidden: int, padding: float) -> np.ndarray:
    """Row-major matrices one after the other, inputs and outputs padded to 16, no biases."""
    x = np.concatenate([x, np.full(-len(x) % 16, padding)])
    sizes, at = [(width, len(x)), *[(width, width)] * (hidden - 1), (16, width)], 0
    for i, (rows, columns) in enumerate(sizes):
        x = packed[at : at + rows * columns].reshape(rows, columns) @ (np.maximum(x, 0) if i else x)
        at += rows * columns
    assert at == len(packed)
    return x


def _staggered(packed: np.ndarray, unit: np.ndarray, levels: int, base: int, finest: int, log2: int) -> np.ndarray:
    """tiny-cuda-nn's grid: positions are shifted by half a cell; a level whose vertices fit is not hashed."""
    table, out, at = packed.reshape(-1, 2), [], 0
    for scale, size in zip(_scales(levels, base, finest), _rows(levels, base, finest, log2)):
        rows, side = table[at : at + size], int(np.ceil(scale)) + 1

        def row(c: tuple[int, int, int], rows: np.ndarray = rows, side: int = side) -> np.ndarray:
            fits = side**3 <= len(rows)
            return rows[(c[0] + c[1] * side + c[2] * side**2) % len(rows) if fits else hashed(c, len(rows))]

        out.append(trilinear(unit * scale + 0.5, row))
        at += size
    return np.concatenate(out)


def trilinear(p: np.ndarray, row) -> np.ndarray:
    low = np.floor(p).astype(int)
    f, corners = p - low, list(np.ndindex(2, 2, 2))
    return sum(np.prod(np.where(c, f, 1 - f)) * row(tuple(int(v) for v in low + c)) for c in corners)


def _unit(x: np.ndarray) -> np.ndarray:
    far = np.abs(x).max()
    return ((x if far < 1 else (2 - 1 / far) * x / far) + 2) / 4


def _harmonics(d: np.ndarray, sign: int) -> np.ndarray:
    """``sign`` of those that are odd in x and y together: nerfstudio's torch code has 1, tiny-cuda-nn -1."""
    x, y, z = d
    s = sign
    return np.array(
        [
            0.28209479177387814,
            s * 0.4886025119029199 * y,
            0.4886025119029199 * z,
            s * 0.4886025119029199 * x,
            1.0925484305920792 * x * y,
            s * 1.0925484305920792 * y * z,
            0.9461746957575601 * z * z - 0.31539156525252,
            s * 1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
            s * 0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            s * 0.4570457994644658 * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),
            s * 0.4570457994644658 * x * (5 * z * z - 1),
            1.445305721320277 * z * (x * x - y * y),
            s * 0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    )


def _distance(s: np.ndarray) -> np.ndarray:
    s = s * (1 - 1 / 2000)
    return np.where(s < 0.5, 2 * s, 1 / (2 - 2 * s))


def _middles(origin: np.ndarray, d: np.ndarray, edges: np.ndarray) -> np.ndarray:
    t = _distance(edges)
    return origin + d * ((t[1:] + t[:-1]) / 2)[:, None]


def _weights(sigmas: list[float], edges: np.ndarray) -> np.ndarray:
    depth = np.array(sigmas) * np.diff(_distance(edges))
    return (1 - np.exp(-depth)) * np.exp(-np.concatenate([[0], np.cumsum(depth)[:-1]]))
