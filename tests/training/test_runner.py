"""The runner: it trains, resumes without a difference, and refuses other checkpoints."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from envs.terrain_nav import SightConfig
from tests.training.nav.runners import CFG, make_runner, weights
from training.resume import CHECKPOINT

ROOT = Path(__file__).parents[3]


@pytest.mark.slow(1)
def test_training_changes_the_policy_and_logs(tmp_path):
    runner = make_runner(tmp_path)
    before = weights(runner)
    runner.learn(2)
    assert any(not torch.equal(value, before[name]) for name, value in weights(runner).items())
    assert (tmp_path / CHECKPOINT).exists() and list(tmp_path.glob("events.out.tfevents*"))


@pytest.mark.slow(3)
def test_a_resumed_training_equals_one_that_never_stopped(tmp_path):
    whole = make_runner(tmp_path / "whole")
    whole.learn(4)
    first = make_runner(tmp_path / "parts")
    first.learn(2)
    rest = make_runner(tmp_path / "parts")
    rest.resume(tmp_path / "parts" / CHECKPOINT)
    assert rest.current_learning_iteration == 2
    rest.learn(2)
    for name, value in weights(whole).items():
        assert torch.equal(value, weights(rest)[name]), name
    assert whole.logger.tot_timesteps == rest.logger.tot_timesteps == 4 * 6 * 4


@pytest.mark.slow(1)
def test_a_checkpoint_of_other_observations_is_refused_before_anything_changed(tmp_path):
    make_runner(tmp_path, "blind").learn(1)
    sight = SightConfig(crop_length=2.4)
    other = make_runner(None, "blind", dataclasses.replace(CFG, sight=sight))
    before = weights(other)
    with pytest.raises(ValueError, match=r"checkpoint: must be of observations .*12, 12.*got .*16, 16"):
        other.resume(tmp_path / CHECKPOINT)
    assert all(torch.equal(value, before[name]) for name, value in weights(other).items())


@pytest.mark.slow(1)
@pytest.mark.parametrize("perception, num_envs, named", [("truth", 4, "perception truth"), ("blind", 3, "num_envs 3")])
def test_a_checkpoint_of_another_kind_is_refused_before_anything_changed(tmp_path, perception, num_envs, named):
    make_runner(tmp_path, "blind").learn(1)
    other = make_runner(None, perception, num_envs=num_envs)
    before = weights(other)
    with pytest.raises(ValueError, match=f"checkpoint: must be of {named}, got"):
        other.resume(tmp_path / CHECKPOINT)
    assert all(torch.equal(value, before[name]) for name, value in weights(other).items())


@pytest.mark.slow(1)
@pytest.mark.parametrize("content", [b"", b"no checkpoint", None])
def test_a_damaged_checkpoint_is_refused(tmp_path, content):
    make_runner(tmp_path, "blind").learn(1)
    path = tmp_path / CHECKPOINT
    path.write_bytes(path.read_bytes()[:2000] if content is None else content)
    with pytest.raises(
        ValueError, match=r"checkpoint: must be a file that a training saved, got .*checkpoint.pt, which"
    ):
        make_runner(None, "blind").resume(path)


@pytest.mark.slow(1)
def test_a_checkpoint_of_other_sizes_is_refused_before_anything_changed(tmp_path):
    make_runner(tmp_path, "blind").learn(1)
    path, other = tmp_path / CHECKPOINT, make_runner(None, "blind")
    saved, before = torch.load(path, weights_only=False), weights(other)
    name = next(name for name, value in saved["actor_state_dict"].items() if value.ndim == 2 and len(value) > 2)
    saved["actor_state_dict"][name] = saved["actor_state_dict"][name][:-1]
    torch.save(saved, path)
    with pytest.raises(
        ValueError, match=rf"checkpoint: the actor's {name} must be of size .*, got .*; use the settings"
    ):
        other.resume(path)
    assert all(torch.equal(value, before[key]) for key, value in weights(other).items())


@pytest.mark.slow(1)
def test_ctrl_c_leaves_a_checkpoint(tmp_path):
    runner = make_runner(tmp_path, "blind")
    log = runner.logger.log

    def stop_in_the_second(**figures):
        if figures["it"] == 1:
            os.kill(os.getpid(), 2)
        log(**figures)

    runner.logger.log = stop_in_the_second
    with pytest.raises(KeyboardInterrupt):
        runner.learn(10)
    again = make_runner(tmp_path, "blind")
    again.resume(tmp_path / CHECKPOINT)
    assert again.current_learning_iteration == 2


@pytest.mark.slow(10)
def test_two_processes_train_one_policy(tmp_path):
    script = tmp_path / "two.py"
    script.write_text(
        "import os, torch, tests.training.nav.runners as t\n"
        "torch.set_num_threads(1)\n"
        f"folder = r'{tmp_path}/run'\n"
        "runner = t.make_runner(folder, 'blind', seed=int(os.environ['RANK']))\n"
        "if os.path.exists(folder + '/checkpoint.pt'):\n"
        "    runner.resume(folder + '/checkpoint.pt')\n"
        "runner.learn(2)\n"
        "runner.close()\n"
        "total = sum(value.double().sum() for value in t.weights(runner).values())\n"
        "place = float(runner.env.task.xy.sum())\n"
        f"open(r'{tmp_path}/' + str(runner.gpu_global_rank), 'w').write(repr([float(total), place]))\n"
    )
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    totals = []
    for _ in range(2):  # the second goes on where the first ended
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr[-2000:]
        one, other = (json.loads((tmp_path / name).read_text()) for name in "01")
        assert one[0] == other[0], "the processes' policies differ"
        assert one[1] != other[1], "both processes walk the same robots"
        totals.append(one[0])
    assert totals[0] != totals[1]
