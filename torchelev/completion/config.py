"""The settings of the completion stage."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torchelev.errors import require, require_positive
from torchelev.files.weight_files import require_resolution

WHEN = ("read", "update")


@dataclass(frozen=True, kw_only=True)
class CompletionConfig:
    """Prediction of the ground that no sensor saw: the layers `completed` and `completed_std`."""

    weights: str | Path | None = None  #: file that `CompletionNet.save` wrote; None: the shipped weights
    #: "read": when a layer is read, and kept until the map changes; "update": at the end of every update
    when: str = "read"
    write_back: bool = False  #: True: at the end of every update, unknown cells take the completed height
    max_std: float = 0.05  #: [m] only where its standard deviation is below this

    def __post_init__(self) -> None:
        is_path = self.weights is None or isinstance(self.weights, str | Path)
        rule = "must be a path or None"
        require(is_path, "completion.weights", rule, repr(self.weights), "give a str", TypeError)
        require(self.when in WHEN, "completion.when", f"must be one of {', '.join(WHEN)}", repr(self.when), "use read")
        is_bool, rule = isinstance(self.write_back, bool), "must be a bool"
        require(is_bool, "completion.write_back", rule, repr(self.write_back), "give True or False", TypeError)
        require_positive(**{"completion.max_std": self.max_std})
        if isinstance(self.weights, Path):
            object.__setattr__(self, "weights", str(self.weights))  # as files of settings hold it

    def require_resolution(self, resolution: float) -> None:
        """Refuse a map's resolution for which the network is not trained. Raises ValueError."""
        hint = "choose another resolution, or leave completion off with None"
        require_resolution(resolution, "cfg.grid.resolution", " for completion", hint)
