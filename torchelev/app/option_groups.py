"""Options that a command's help lists by group."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

_OTHER = "Other options"


class GroupedOption(click.Option):
    """An option of a group.

    Args:
        group: title in the help.
        arguments: those of `click.Option`.
    """

    def __init__(self, *arguments: Any, group: str, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self.group = group


class GroupedCommand(click.Command):
    """A command whose help lists the options by group, in the order of the options."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options, those without a group last."""
        groups: dict[str, list[tuple[str, str]]] = {}
        options = [parameter for parameter in self.get_params(ctx) if isinstance(parameter, click.Option)]
        for option in sorted(options, key=lambda option: not isinstance(option, GroupedOption)):
            record = option.get_help_record(ctx)
            if record is not None:
                groups.setdefault(getattr(option, "group", _OTHER), []).append(record)
        for title, records in groups.items():
            with formatter.section(title):
                formatter.write_dl(records)


def option_of(group: str) -> Callable[..., Callable[[Any], Any]]:
    """Return `click.option` for the options of a group."""
    return lambda *names, **named: click.option(*names, cls=GroupedOption, group=group, **named)
