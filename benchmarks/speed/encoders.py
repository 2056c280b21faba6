"""Time encoders of the map in rsl-rl's models: an MLP, a CNN and attention.

    python -m benchmarks.speed.encoders

Times one model each, for 256 environments on one thread: acting, and a step of learning (forward and backward). The
models read 45 numbers of proprioception with a scan of 187 points or an image of 4 x 16 x 16. Writes
benchmarks/results/encoders.json.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click
import torch
from rsl_rl.models import CNNModel, MLPModel
from tensordict import TensorDict

from benchmarks import RESULTS
from benchmarks.speed.common.meter import interleaved
from torchelev.app.results import markdown_table, write_json
from torchelev.encoders.rsl_rl import AttentionModel

NUM_ENVS, STATE_DIM, NUM_ACTIONS = 256, 45, 12
_SHAPES = {"policy": (STATE_DIM,), "scan": (187,), "image": (4, 16, 16)}
_CNN = {"output_channels": [8, 16], "kernel_size": 3, "stride": 2, "padding": "zeros", "activation": "elu"}
_SMALL = {"embed_dim": 32, "num_heads": 4, "hidden_channels": 8}
_GRID = {"points": "isaac_lab", "grid": [11, 17], "kernel_size": 5}
_IMAGE = {"resolution": 0.2, "kernel_size": 3}
CASES: dict[str, tuple[type[MLPModel], str, dict[str, Any]]] = {
    "scan, MLP": (MLPModel, "scan", {}),
    "scan, attention, 32 dimensions": (AttentionModel, "scan", {"scan": _SMALL | {"points": "isaac_lab"}}),
    "scan, attention, 64 dimensions": (AttentionModel, "scan", {"scan": {"points": "isaac_lab"}}),
    "scan, attention, 64 dimensions, kernel 5": (AttentionModel, "scan", {"scan": _GRID}),
    "image, CNN": (CNNModel, "image", _CNN),
    "image, attention, 32 dimensions, patches of 2": (
        AttentionModel,
        "image",
        {"image": _SMALL | _IMAGE | {"patch": 2}},
    ),
    "image, attention, 32 dimensions": (AttentionModel, "image", {"image": _SMALL | _IMAGE}),
}


def make_model(name: str, obs: TensorDict) -> MLPModel:
    """Return the model of a case."""
    cls, group, cfg = CASES[name]
    own = {AttentionModel: {"attention_cfg": cfg}, CNNModel: {"cnn_cfg": cfg}}.get(cls, {})
    groups = {"actor": ["policy", group]}
    return cls(obs, groups, "actor", NUM_ACTIONS, hidden_dims=(256, 128, 64), **own)


def measure(seconds: float, num_envs: int = NUM_ENVS) -> list[dict[str, Any]]:
    """Time the models, in turn."""
    torch.manual_seed(0)
    obs: Any = {name: torch.randn(num_envs, *shape) for name, shape in _SHAPES.items()}
    obs = TensorDict(obs, batch_size=[num_envs])
    models = {name: make_model(name, obs) for name in CASES}
    acting = interleaved({name: _act(model, obs) for name, model in models.items()}, seconds)
    learning = interleaved({name: _learn(model, obs) for name, model in models.items()}, seconds)
    counts = {name: sum(value.numel() for value in model.parameters()) for name, model in models.items()}
    return [{"model": name, "parameters": counts[name], "act": acting[name], "learn": learning[name]} for name in CASES]


def _act(model: MLPModel, obs: TensorDict) -> Callable[[], Any]:
    return torch.inference_mode()(lambda: model(obs))


def _learn(model: MLPModel, obs: TensorDict) -> Callable[[], Any]:
    return lambda: model(obs).sum().backward()


def table(rows: list[dict[str, Any]]) -> str:
    """Tabulate parameters and times [ms]."""
    times = [[f"{row[name]['median']:.2f}" for name in ("act", "learn")] for row in rows]
    lines = [[row["model"], f"{row['parameters']:,}", *one] for row, one in zip(rows, times, strict=True)]
    return markdown_table([f"{NUM_ENVS} environments", "parameters", "act [ms]", "learn [ms]"], lines)


@click.command(help=__doc__)
@click.option("--seconds", default=3.0, show_default=True, help="Time per row and column [s].")
def main(seconds: float) -> None:
    """Measure, write JSON and print the table."""
    torch.set_num_threads(1)
    rows = measure(seconds)
    write_json(RESULTS / "encoders.json", {"num_envs": NUM_ENVS, "rows": rows})
    click.echo(table(rows))


if __name__ == "__main__":
    main()
