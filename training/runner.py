"""rsl-rl's runner with a progress bar, and a resume that gives what an uninterrupted training gives."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner
from tqdm import tqdm

from torchelev.errors import message, require
from torchelev.files.output_files import atomic_file
from training.resume import CHECKPOINT, deferred_interrupt

_DEFAULTS = {
    "encoder": "cnn",
    "fill": "base",
    "course": "open",
    "ceilings": "none",
}  # of configurations and checkpoints that name none
_HINT = "use the settings that it was trained with"
_LOGGER_STATE = ("tot_timesteps", "tot_time", "rewbuffer", "lenbuffer", "cur_reward_sum", "cur_episode_length")


class ResumableRunner(OnPolicyRunner):
    """An `OnPolicyRunner` whose `checkpoint.pt` also holds the environments and the random number generators.

    Ctrl-C ends the training after the running iteration and leaves a checkpoint. Under `torchrun`, processes on CPUs
    communicate by gloo, those on GPUs as rsl-rl sets up, and each process keeps a checkpoint of its own environments.

    Args:
        env: rsl-rl's environment; `env.task` is an `nn.Module` with the whole state of the environments and with
            `perception` and `num_envs`.
        train_cfg: rsl-rl's configuration.
        log_dir: where logs and checkpoints go; None: nowhere.
        device: of the models.
    """

    def __init__(self, env: Any, train_cfg: dict[str, Any], log_dir: str | None = None, device: str = "cpu") -> None:
        with contextlib.redirect_stdout(io.StringIO()):  # rsl-rl prints its models
            super().__init__(env, train_cfg, log_dir, device)
        self._is_interrupted: Callable[[], bool] = lambda: False
        self._log, self.logger.log = self.logger.log, self._show
        self.bar: tqdm[Any] | None = None

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train for a number of iterations, with a progress bar on stderr.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed; the running iteration is finished and saved.
        """
        first, is_quiet = self.current_learning_iteration, self.is_distributed and self.gpu_global_rank != 0
        last = first + num_learning_iterations
        with (
            deferred_interrupt("iteration") as self._is_interrupted,
            tqdm(total=last, initial=first, unit="iteration", disable=is_quiet) as self.bar,
            contextlib.redirect_stdout(io.StringIO()),
        ):
            super().learn(num_learning_iterations, init_at_random_ep_len)

    def close(self) -> None:
        """Leave the group of processes, if there is one; the last call of each process."""
        if self.is_distributed:
            torch.distributed.barrier()
            torch.distributed.destroy_process_group()

    def _show(self, **figures: Any) -> None:
        """Log an iteration as rsl-rl does and update the progress bar; save and stop if asked to."""
        with contextlib.redirect_stdout(io.StringIO()):
            self._log(**figures)
        shown = {name: f"{float(value):.2f}" for name, value in self.env.task.ending_fractions.items()}
        steps = self.cfg["num_steps_per_env"] * self.env.num_envs * self.gpu_world_size
        rate = steps / (figures["collect_time"] + figures["learn_time"])
        assert self.bar is not None
        self.bar.set_postfix(shown | {"steps/s": f"{rate:.0f}"})
        self.bar.update()
        is_last, is_due = figures["it"] + 1 == figures["total_it"], figures["it"] % self.cfg["save_interval"] == 0
        if self.gpu_global_rank and (self._is_interrupted() or is_last or is_due) and self.logger.log_dir:
            self._save_checkpoint(Path(self.logger.log_dir))  # rsl-rl saves in the first process only
        if self._is_interrupted():
            if self.logger.writer is not None:
                self.save(os.path.join(self.logger.log_dir, f"model_{figures['it']}.pt"))
            raise KeyboardInterrupt

    def save(self, path: str, infos: dict[str, Any] | None = None) -> None:
        """Save the models to `path`, and everything that a resume needs to `checkpoint.pt` in the same folder."""
        super().save(path, infos)
        self._save_checkpoint(Path(path).parent)

    def _save_checkpoint(self, folder: Path) -> None:
        state = self.alg.save() | {"iter": self.current_learning_iteration, "infos": self._snapshot()}
        with atomic_file(self._own(folder / CHECKPOINT)) as file:
            torch.save(state, file)

    def _own(self, path: Path) -> Path:
        """Return the path of this process's checkpoint, given that of the first process."""
        return path.with_stem(f"{path.stem}-rank{self.gpu_global_rank}") if self.gpu_global_rank else path

    def _kind(self) -> dict[str, Any]:
        """Return the settings that a checkpoint must share with this training."""
        shapes = {name: tuple(value.shape[1:]) for name, value in sorted(self.env.get_observations().items())}
        task = self.env.task
        settings = {"perception": task.perception, "num_envs": task.num_envs, "processes": self.gpu_world_size}
        named = {name: self.cfg.get(name, default) for name, default in _DEFAULTS.items()}
        return {"observations": shapes, **settings, **named}

    def _snapshot(self) -> dict[str, Any]:
        cuda = str(self.device).startswith("cuda")
        return {
            "kind": self._kind(),
            "task": self.env.task.state_dict(),
            "random": torch.get_rng_state(),
            "random_cuda": torch.cuda.get_rng_state(self.device) if cuda else None,
            "logger": {name: getattr(self.logger, name) for name in _LOGGER_STATE},
        }

    def resume(self, path: str | Path) -> None:
        """Continue from a `checkpoint.pt`.

        Raises:
            ValueError: the checkpoint is damaged, has other observations, weights of other sizes, another perception,
                encoder, fill, course or ceilings, or another number of environments or processes; nothing has changed
                then.
        """
        path = self._own(Path(path))
        saved = _read(path, self.device)
        found: Any = saved.get("infos")
        require(found is not None, "checkpoint", "must hold the environments", str(path), f"give a {CHECKPOINT}")
        for name, expected in self._kind().items():
            actual = (_DEFAULTS | found["kind"])[name]
            require(actual == expected, "checkpoint", f"must be of {name} {expected}", actual, _HINT)
        _require_sizes(saved, self.alg.save())
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
        # The same as rsl-rl does for GPUs, for processes on CPUs.
        rank, local = int(os.environ["RANK"]), int(os.environ["LOCAL_RANK"])
        self.is_distributed, self.gpu_world_size, self.gpu_global_rank, self.gpu_local_rank = True, world, rank, local
        self.cfg["multi_gpu"] = {"global_rank": rank, "local_rank": local, "world_size": world}
        torch.distributed.init_process_group("gloo", rank=rank, world_size=world)


def export_onnx(runner: OnPolicyRunner, path: Path, **metadata: str) -> None:
    """Write the policy to one ONNX file: with its weights, which torch puts beside it, and further metadata."""
    import onnx

    runner.export_policy_to_onnx(str(path.parent), path.name)
    model = onnx.load(str(path))
    onnx.helper.set_model_props(model, metadata)
    onnx.save(model, str(path))
    path.with_name(f"{path.name}.data").unlink(missing_ok=True)


def _read(path: Path, device: torch.device | str) -> dict[str, Any]:
    """Return what a checkpoint holds.

    Raises:
        ValueError: the file is damaged, or is not a checkpoint.
    """
    rule, hint = "must be a file that a training saved", "restore a copy of it, or begin again in another folder"
    try:
        saved = torch.load(path, weights_only=False, map_location=device)
    except FileNotFoundError:
        raise
    except Exception as error:  # whatever the zip file and its pickles raise
        actual = f"{path}, which cannot be read ({type(error).__name__})"
        raise ValueError(message("checkpoint", rule, actual, hint)) from None
    require(isinstance(saved, dict), "checkpoint", rule, f"{path}, which holds a {type(saved).__name__}", hint)
    return dict(saved)


def _require_sizes(saved: dict[str, Any], own: dict[str, Any]) -> None:
    """Raise ValueError unless the actor's and the critic's saved weights have the sizes of this training's."""
    for model in ("actor", "critic"):
        expected, actual = (
            {name: tuple(value.shape) for name, value in state.get(f"{model}_state_dict", {}).items()}
            for state in (own, saved)
        )
        for name in expected | actual:
            size, found = expected.get(name, "none"), actual.get(name, "none")
            require(size == found, "checkpoint", f"the {model}'s {name} must be of size {size}", found, _HINT)
