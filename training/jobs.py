"""Several trainings of one experiment, each in its own process; those that are finished are kept."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from training.resume import CHECKPOINT


class Job(NamedTuple):
    """A training: `python -m MODULE ARGUMENTS --out FOLDER`, finished when FOLDER holds result.json."""

    module: str
    arguments: dict[str, object]  #: by option; None leaves an option out
    folder: Path


def command_of(job: Job) -> list[str]:
    """Return the command that runs a training, or resumes one that was interrupted."""
    command = [sys.executable, "-m", job.module, "--out", str(job.folder)]
    for option, value in job.arguments.items():
        command += [] if value is None else [option, str(value)]
    return command + (["--resume"] if (job.folder / CHECKPOINT).exists() else [])


def train(job: Job) -> None:
    """Run a training, or resume one that was interrupted; its output goes to FOLDER/log.txt."""
    command = command_of(job)
    job.folder.mkdir(parents=True, exist_ok=True)
    with (job.folder / "log.txt").open("a") as log:
        # Two trainings on a core each are faster than one after the other on both.
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        subprocess.run(command, check=True, env=environment, stdout=log, stderr=subprocess.STDOUT)


def train_all(jobs: Sequence[Job], num_parallel: int, train: Callable[[Job], None] = train) -> None:
    """Run the unfinished trainings, `num_parallel` at a time."""
    unfinished = [job for job in jobs if not (job.folder / "result.json").exists()]
    bar = tqdm(total=len(jobs), initial=len(jobs) - len(unfinished), unit="training")
    with ThreadPoolExecutor(num_parallel) as pool, bar:
        try:
            for done in as_completed([pool.submit(train, job) for job in unfinished]):
                done.result()
                bar.update()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)  # otherwise the queued trainings would start
            raise
