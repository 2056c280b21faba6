"""A wheel with the libraries of `torchelev/kernels/built`, which `make wheel` builds, is of one platform."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class LibrariesHook(BuildHookInterface):
    """Let a wheel with libraries name its platform; without them it is pure Python, and builds them at first use."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Set what hatchling asks of the wheel."""
        libraries = list((Path(self.root) / "torchelev" / "kernels" / "built").glob("*.so"))
        if version != "editable" and libraries:
            build_data["pure_python"] = False
            build_data["tag"] = f"py3-none-{_platform()}"
            build_data["artifacts"] += ["torchelev/kernels/built/*.so", "torchelev/kernels/built/*.h*"]


def _platform() -> str:
    from packaging.tags import sys_tags

    return next(tag.platform for tag in sys_tags() if "manylinux" not in tag.platform and "musl" not in tag.platform)
