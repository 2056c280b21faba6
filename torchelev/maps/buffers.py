"""A map's state as buffers of a module: it moves with `.to()`, and `state_dict` saves it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor, nn

from torchelev.config import ElevationMapConfig, differing_fields
from torchelev.errors import require
from torchelev.files.config_files import split_off_completion
from torchelev.grid import cell_centers, window_center
from torchelev.state import CARRIED, MapState, Statistics, blank_state, map_layers

if TYPE_CHECKING:
    from jaxtyping import Float

_LAYERS = MapState._fields[:-1]
_STATISTICS = tuple(f"last_{name}" for name in Statistics._fields)
_CARRIED = tuple(f"last_{name}" for name in CARRIED)


def name_tensors(state: MapState) -> dict[str, Tensor]:
    """Return a state's tensors by the names of their buffers: each field's own, and `last_<name>` for statistics."""
    return dict(zip((*_LAYERS, *_STATISTICS), (*state[:-1], *state.statistics), strict=True))


def state_of(tensors: Mapping[str, Tensor]) -> MapState:
    """Return the state whose tensors `name_tensors` named."""
    layers = {name: tensors[name] for name in _LAYERS}
    return MapState(**layers, statistics=Statistics(*[tensors[name] for name in _STATISTICS]))


def without_shared_memory(state: MapState, given: Iterable[object]) -> MapState:
    """Copy the tensors of a state that are among the given ones, which their owner may overwrite."""
    given = tuple(given)
    # Compared by `is`: the compiler would make its graphs depend on the values of `id`.
    return map_layers(lambda value: value.clone() if any(value is other for other in given) else value, state)


class MapBuffers(nn.Module):
    """Config and state of B maps.

    The buffers are written in place. A rebound buffer would break `deepcopy` once gradients flow, and would become an
    inference tensor inside `torch.inference_mode()`.
    """

    corner: Tensor
    base_height: Tensor
    elevation: Tensor

    def __init__(self, cfg: ElevationMapConfig, num_envs: int, device: torch.device | str) -> None:
        super().__init__()
        self.cfg, self.num_envs = cfg, num_envs
        with torch.inference_mode(False):  # an inference tensor could not be written outside of that mode
            state = blank_state(cfg.grid, num_envs, device, torch.float32)
        for name, value in name_tensors(state).items():
            self.register_buffer(name, value, persistent=name not in _STATISTICS or name in _CARRIED)

    @property
    def device(self) -> torch.device:
        """The device that holds the maps."""
        return self.elevation.device

    @property
    def state(self) -> MapState:
        """The maps' buffers as one value. The next update overwrites them; clone what you keep."""
        return state_of(cast("dict[str, Tensor]", self._buffers))  # attributes would take five times as long

    @property
    def statistics(self) -> Statistics:
        """What the last update did, as fresh (B,) tensors."""
        return Statistics(*(value.clone() for value in self.state.statistics))

    @property
    def center(self) -> Float[Tensor, "B 3"]:
        """Centres of the windows [m], map frame, float64; z is the last height of the base."""
        xy = window_center(self.corner, self.cfg.grid)
        return torch.cat([xy, self.base_height.double()[:, None]], -1)

    def cell_centers(self) -> Float[Tensor, "B H W 2"]:
        """Return the cell centres [m], map frame, float64."""
        return cell_centers(self.corner, self.cfg.grid)

    def load_state(self, state: MapState) -> None:
        """Copy a state into the buffers, such as one that `forward` returned.

        Args:
            state: state of the same grid and number of environments; its values are converted to the map's dtype.

        Raises:
            ValueError: if a tensor of the state has another shape.
        """
        for (name, stored), value in zip(name_tensors(self.state).items(), name_tensors(state).values(), strict=True):
            expected, actual = tuple(stored.shape), tuple(value.shape)
            hint = "give a state of the same grid and number of environments"
            require(actual == expected, f"state.{name}", f"expected {expected}", actual, hint)
        self._forget_derived()
        with torch.no_grad():
            map_layers(Tensor.copy_, self.state, state)
            if self.cfg.traversability is None:  # no stage would rate these cells again
                self.state.rated.zero_(), self.state.traversability.zero_()

    def _forget_derived(self) -> None:
        """Forget what belongs to the state that was here before; called when all of it is replaced or moved."""

    def get_extra_state(self) -> dict[str, Any]:
        """Return the config as plain dicts, for `state_dict`."""
        return {"config": self.cfg.to_dict()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Do nothing: `load_state_dict` compares the configs before it loads anything."""

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        """Load a checkpoint, or refuse one of another config before anything changes, naming the settings."""
        extra = state_dict.get(f"{prefix}_extra_state")
        ignored = ("filters", "traversability.weights")  # filters hold no state, weights come from this checkpoint
        stored = split_off_completion(extra["config"])[0] if extra else self.cfg.to_dict()
        fields = differing_fields(self.cfg.to_dict(), stored)
        fields = [name for name in fields if not name.startswith(ignored)]
        hint = "build the map with ElevationMapConfig.from_dict(checkpoint['_extra_state']['config'])"
        require(not fields, "state_dict", "must be of the same config", f"other {', '.join(fields)}", hint)
        for name in ("pose_covariance", "elapsed", *_CARRIED):  # absent from older checkpoints
            state_dict.setdefault(f"{prefix}{name}", torch.zeros_like(self.get_buffer(name)))
        self._forget_derived()
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _apply(self, fn: Callable[[Tensor], Tensor], *args: Any, **kwargs: Any) -> Any:
        self._forget_derived()
        return super()._apply(fn, *args, **kwargs)

    def extra_repr(self) -> str:
        """Say how many maps there are, and how large they are."""
        grid = self.cfg.grid
        size = f"{grid.length_x:g} x {grid.length_y:g} m, resolution={grid.resolution:g} m"
        return f"num_envs={self.num_envs}, {size}, device={self.device}"
