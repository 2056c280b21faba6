"""A robot as a command-line option."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import click
import yaml

from torchelev.robot import RobotConfig


class RobotType(click.ParamType):
    """`length=0.7,width=0.4` or a YAML file with the same names; other fields keep their defaults."""

    name = "robot"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> RobotConfig:
        """Return the robot; raise click.BadParameter if a name or value is wrong."""
        if isinstance(value, RobotConfig):
            return value
        names = [field.name for field in dataclasses.fields(RobotConfig)]
        try:
            sizes = _read(str(value))
            unknown = [name for name in sizes if name not in names]
            if unknown:
                raise ValueError(f"there is no {', '.join(unknown)}; there are {', '.join(names)}")
            return RobotConfig(**sizes)
        except (ValueError, OSError, yaml.YAMLError) as error:
            self.fail(str(error), param, ctx)


def _read(text: str) -> dict[str, float]:
    if text.endswith((".yaml", ".yml")):
        values = yaml.safe_load(Path(text).read_text())
        if not isinstance(values, dict):
            raise ValueError(f"{text} must hold a mapping, such as length: 0.7")
        return values
    pairs = [part.partition("=") for part in text.split(",") if part.strip()]
    return {name.strip(): _number(name, value) for name, _, value in pairs}


def _number(name: str, value: str) -> float:
    try:
        return float(value)
    except ValueError:
        raise ValueError(f"{name.strip()} must be a number, got {value!r}; give pairs such as length=0.7") from None
