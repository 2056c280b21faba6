"""The map that a node keeps: PyTorch's, or that of the C library, which needs no PyTorch. Both give the same bits."""

from __future__ import annotations

import importlib.util
from typing import Any

from torchelev.errors import require
from torchelev.ros2.engine import Engine
from torchelev.ros2.library_engine import LibraryEngine
from torchelev.ros2.settings import NodeSettings


def make_engine(cfg: dict[str, Any], settings: NodeSettings) -> Engine:
    """Return the engine that the settings ask for.

    Args:
        cfg: the map's settings as nested dicts.
        settings: the node's.

    Raises:
        ValueError: the settings of the map do not fit, or the engine is not installed.
    """
    has_torch = importlib.util.find_spec("torch") is not None
    if settings.engine == "torch" or (settings.engine == "auto" and has_torch):
        hint = "install PyTorch, or set engine to library"
        require(has_torch, "engine", "must be installed", "no PyTorch", hint)
        from torchelev.ros2.torch_engine import TorchEngine

        engine: Engine = TorchEngine(cfg, settings)
    else:
        engine = LibraryEngine(cfg, settings)
    fits = not settings.robot_height or engine.levels is not None
    hint = "set map.levels.max_levels to 3, or leave robot_height out"
    require(fits, "robot_height", "needs a map with levels, which knows ceilings", settings.robot_height, hint)
    return engine
