"""rsl-rl's runner with what long trainings need: a progress bar, and a resume that goes on as if never stopped."""

from __future__ import annotations

import contextlib
import io
import os
import signal
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner
from tqdm import tqdm

from torchelev.errors import require
from torchelev.output_files import atomic_file

CHECKPOINT = "checkpoint.pt"
LOGGED = ("tot_timesteps", "tot_time", "rewbuffer", "lenbuffer", "cur_reward_sum", "cur_episode_length")


class ResumableRunner(OnPolicyRunner):
    """An `OnPolicyRunner` whose `checkpoint.pt` holds the environments and random numbers too.

    `env.task` is an `nn.Module` with the whole state of the environments, and a `perception`. Ctrl-C ends the training
    after the running iteration and leaves a checkpoint. Under `torchrun` it uses gloo on CPUs and rsl-rl's own way on
    GPUs, and each process keeps a checkpoint of its own environments.
    """

    def __init__(self, env: Any, train_cfg: dict[str, Any], log_dir: str | None = None, device: str = "cpu") -> None:
        with contextlib.redirect_stdout(io.StringIO()):  # rsl-rl prints its models
            super().__init__(env, train_cfg, log_dir, device)
        self._stop = False
        self._log, self.logger.log = self.logger.log, self._show
        self.bar: tqdm[Any] | None = None

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train for some iterations, with a progress bar on stderr."""
        before = signal.signal(signal.SIGINT, self._ask_to_stop)
        first, quiet = self.current_learning_iteration, self.is_distributed and self.gpu_global_rank != 0
        last = first + num_learning_iterations
        try:
            with tqdm(total=last, initial=first, unit="iteration", disable=quiet) as self.bar:
                with contextlib.redirect_stdout(io.StringIO()):
                    super().learn(num_learning_iterations, init_at_random_ep_len)
        finally:
            signal.signal(signal.SIGINT, before)

    def close(self) -> None:
        """Part from the other processes, if there are any; the last call of each."""
        if self.is_distributed:
            torch.distributed.barrier()
            torch.distributed.destroy_process_group()

    def _ask_to_stop(self, number: int, frame: FrameType | None) -> None:
        self._stop = True
        tqdm.write("Stopping after this iteration; --resume goes on.")

    def _show(self, **figures: Any) -> None:
        """Log an iteration as rsl-rl does, and show it in the bar."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._log(**figures)
        shown = {name: f"{float(share):.2f}" for name, share in self.env.task.ending_fractions.items()}
        steps = self.cfg["num_steps_per_env"] * self.env.num_envs * self.gpu_world_size
        rate = steps / (figures["collect_time"] + figures["learn_time"])
        assert self.bar is not None
        self.bar.set_postfix(shown | {"steps/s": f"{rate:.0f}"})
        self.bar.update()
        last, due = figures["it"] + 1 == figures["total_it"], figures["it"] % self.cfg["save_interval"] == 0
        if self.gpu_global_rank and (self._stop or last or due) and self.logger.log_dir:
            self._save_whole(Path(self.logger.log_dir))  # rsl-rl lets the first process save alone
        if self._stop:
            if self.logger.writer is not None:
                self.save(os.path.join(self.logger.log_dir, f"model_{figures['it']}.pt"))
            raise KeyboardInterrupt

    def save(self, path: str, infos: dict[str, Any] | None = None) -> None:
        """Save the models to `path`, and all that a resume needs to `checkpoint.pt` beside it."""
        super().save(path, infos)
        self._save_whole(Path(path).parent)

    def _save_whole(self, folder: Path) -> None:
        whole = self.alg.save() | {"iter": self.current_learning_iteration, "infos": self._snapshot()}
        with atomic_file(self._own(folder / CHECKPOINT)) as file:
            torch.save(whole, file)

    def _own(self, path: Path) -> Path:
        """Return this process's checkpoint beside the first one's."""
        return path.with_stem(f"{path.stem}-rank{self.gpu_global_rank}") if self.gpu_global_rank else path

    def _kind(self) -> dict[str, Any]:
        """Return what a checkpoint must agree in."""
        shapes = {name: tuple(value.shape[1:]) for name, value in sorted(self.env.get_observations().items())}
        task = self.env.task
        settings = {"perception": task.perception, "num_envs": task.num_envs, "processes": self.gpu_world_size}
        return {"observations": shapes, **settings}

    def _snapshot(self) -> dict[str, Any]:
        cuda = str(self.device).startswith("cuda")
        return {
            "kind": self._kind(),
            "task": self.env.task.state_dict(),
            "random": torch.get_rng_state(),
            "random_cuda": torch.cuda.get_rng_state(self.device) if cuda else None,
            "logger": {name: getattr(self.logger, name) for name in LOGGED},
        }

    def resume(self, path: str | Path) -> None:
        """Go on from a `checkpoint.pt`.

        Raises ValueError, before anything changed, if it is of other observations, of another perception or number of
        environments, or of another number of processes.
        """
        path = self._own(Path(path))
        found = torch.load(path, weights_only=False, map_location=self.device)["infos"]
        require(found is not None, "checkpoint", "must hold the environments", str(path), f"give a {CHECKPOINT}")
        for name, here in self._kind().items():
            there, hint = found["kind"][name], "use the settings that it was trained with"
            require(there == here, "checkpoint", f"must be of {name} {here}", there, hint)
        self.load(str(path), map_location=self.device)
        self.env.task.load_state_dict(found["task"])
        torch.set_rng_state(found["random"].cpu())
        if found["random_cuda"] is not None:
            torch.cuda.set_rng_state(found["random_cuda"].cpu(), self.device)
        for name, value in found["logger"].items():
            setattr(self.logger, name, value)
        self.current_learning_iteration += 1  # the saved one was complete

    def _configure_multi_gpu(self) -> None:
        world = int(os.environ.get("WORLD_SIZE", "1"))
        if world == 1 or not str(self.device).startswith("cpu"):
            return super()._configure_multi_gpu()
        # rsl-rl knows GPUs alone; the same for processes on CPUs.
        rank, local = int(os.environ["RANK"]), int(os.environ["LOCAL_RANK"])
        self.is_distributed, self.gpu_world_size, self.gpu_global_rank, self.gpu_local_rank = True, world, rank, local
        self.cfg["multi_gpu"] = {"global_rank": rank, "local_rank": local, "world_size": world}
        torch.distributed.init_process_group("gloo", rank=rank, world_size=world)
