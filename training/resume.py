"""How a training stops and resumes: the output folder is checked, and Ctrl-C waits for the running step."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import click
from tqdm import tqdm

from torchelev.app.results import to_json
from torchelev.files.output_files import atomic_file

CHECKPOINT = "checkpoint.pt"


def checkpoint_path(folder: Path, resume: bool) -> Path:
    """Return the path of the checkpoint in an output folder.

    Raises:
        click.UsageError: it is missing although the training is to resume, or it exists although it is to begin.
    """
    path = folder / CHECKPOINT
    if resume and not path.exists():
        raise click.UsageError(f"--resume: there is no {path}; leave --resume out to begin")
    if not resume and path.exists():
        raise click.UsageError(f"--out: {folder} holds a training; add --resume, or choose another folder")
    return path


@contextlib.contextmanager
def deferred_interrupt(unit: str) -> Iterator[Callable[[], bool]]:
    """Let Ctrl-C wait for the end of the running `unit`; yield a function that returns whether it was pressed."""
    pressed: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        pressed.append(number)
        tqdm.write(f"Stopping after this {unit}; continue with --resume.")

    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def command_errors() -> Iterator[None]:
    """Show the errors of a training's values, and Ctrl-C, as a command does: in a sentence."""
    try:
        yield
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    except KeyboardInterrupt:
        raise click.ClickException("stopped; the progress is saved, continue with --resume") from None


def write_result(path: Path, values: dict[str, Any]) -> None:
    """Write a result as strict JSON; an interruption leaves an older file intact."""
    with atomic_file(path) as file:
        file.write(to_json(values).encode())
