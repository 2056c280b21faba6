"""Training TerrainNav with rsl-rl: it runs, resumes as if never stopped, exports, and refuses what does not fit."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from click.testing import CliRunner

import training.nav.export as nav_export
import training.nav.train as nav
from envs.terrain_nav import CourseConfig, SightConfig, TerrainNav, TerrainNavConfig
from envs.terrain_nav.rsl_rl import RslRlTerrainNav
from training.nav.runner import CHECKPOINT, ResumableRunner

ROOT = Path(__file__).parents[2]
CFG = TerrainNavConfig(course=CourseConfig(num_tiles=2, num_routes=8), episode_length=2.0)


def make_runner(folder, perception="map", cfg=CFG, num_envs=4, seed=0):
    torch.manual_seed(seed)
    task = TerrainNav(cfg, num_envs, perception=perception, seed=seed)
    settings = nav.ppo_config(num_steps=6, save_interval=100)
    return ResumableRunner(RslRlTerrainNav(task), settings, str(folder) if folder else None)


def weights(runner):
    return {name: value.clone() for name, value in runner.alg.get_policy().state_dict().items()}


def test_a_vec_env_of_rsl_rl():
    env = RslRlTerrainNav(TerrainNav(CFG, 4, perception="truth"))
    seen = env.get_observations()
    assert set(seen.keys()) == {"policy", "map", "truth"} and seen.batch_size == (4,)
    for step in range(1, 11):
        seen, reward, done, extras = env.step(torch.tensor([[0.0, 1.0]] * 4))
        assert reward.shape == done.shape == extras["time_outs"].shape == (4,)
        assert bool(done.all()) == (step == 10)
    assert extras["time_outs"].tolist() == [1.0] * 4 and float(extras["log"]["/truncated"]) == 1.0
    assert env.episode_length_buf.tolist() == [0] * 4
    env.task._put("goal", env.task.xy)
    _, _, done, extras = env.step(torch.zeros(4, 2))
    assert bool(done.all()) and not bool(extras["time_outs"].any()), "a success is no time-out"
    env.episode_length_buf = torch.tensor([1, 2, 3, 4])
    assert env.task.episode_length.tolist() == [1, 2, 3, 4]


def test_its_steps_are_those_of_the_task():
    one, other = (TerrainNav(CFG, 3, seed=5) for _ in range(2))
    env = RslRlTerrainNav(one)
    other.reset()
    other.sense()
    for step in range(1, 12):  # an episode has ten
        actions = torch.tensor([[1.0, 0.1 * step], [0.5, -1.0], [0.0, 0.0]])
        seen, reward, done, extras = env.step(actions)
        outcome = other.advance(actions)
        other.reset(outcome.done)
        other.sense()
        for name, expected in other.observe().items():
            assert torch.equal(seen[name], expected), name
        assert torch.equal(reward, outcome.reward) and torch.equal(done, outcome.done.long())
        assert torch.equal(extras["time_outs"], outcome.truncated.float())
        assert extras["log"] == {f"/{name}": share for name, share in other.shares.items()}
    assert env.cfg == dataclasses.asdict(CFG) and env.max_episode_length == 10
    other.reset()
    one.load_state_dict(other.state_dict())
    for name, expected in other.observe().items():
        assert torch.equal(env.get_observations()[name], expected), f"{name} is not read anew"


def test_it_steps_in_inference_mode_and_outside_in_turn():
    env = RslRlTerrainNav(TerrainNav(CFG, 2))
    for _ in range(2):
        with torch.inference_mode():
            env.step(torch.zeros(2, 2))
        env.step(torch.zeros(2, 2))
        env.task.reset()


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


def test_a_checkpoint_of_other_observations_is_refused_before_anything_changed(tmp_path):
    make_runner(tmp_path, "blind").learn(1)
    sight = SightConfig(crop_length=2.4)
    other = make_runner(None, "blind", dataclasses.replace(CFG, sight=sight))
    before = weights(other)
    with pytest.raises(ValueError, match=r"checkpoint: must be of observations .*12, 12.*got .*16, 16"):
        other.resume(tmp_path / CHECKPOINT)
    assert all(torch.equal(value, before[name]) for name, value in weights(other).items())


@pytest.mark.parametrize("perception, num_envs, named", [("truth", 4, "perception truth"), ("blind", 3, "num_envs 3")])
def test_a_checkpoint_of_another_kind_is_refused_before_anything_changed(tmp_path, perception, num_envs, named):
    make_runner(tmp_path, "blind").learn(1)
    other = make_runner(None, perception, num_envs=num_envs)
    before = weights(other)
    with pytest.raises(ValueError, match=f"checkpoint: must be of {named}, got"):
        other.resume(tmp_path / CHECKPOINT)
    assert all(torch.equal(value, before[name]) for name, value in weights(other).items())


def invoke(*arguments):
    return CliRunner().invoke(nav.main, [*map(str, arguments), "--no-compile"], catch_exceptions=False)


@pytest.mark.slow(10)
def test_the_command_trains_evaluates_draws_exports_and_resumes(tmp_path, monkeypatch):
    monkeypatch.setattr(nav, "task_config", lambda held_out=False: CFG)
    out = tmp_path / "run"
    common = ("--num-envs", 4, "--out", out, "--episodes", 4, "--perception", "map")
    assert invoke(*common, "--iterations", 2).exit_code == 0
    result = json.loads((out / "result.json").read_text())
    ends = ("success", "fallen", "stuck", "truncated")
    assert sum(result["evaluation"][name] for name in ends) == pytest.approx(1.0)
    assert result["training"]["steps"] == 2 * 24 * 4
    for name in ("episode.png", "policy.pt", "policy.onnx"):
        assert (out / name).stat().st_size > 1000
    refused = invoke(*common)
    assert refused.exit_code == 2 and "add --resume" in refused.output
    assert invoke(*common, "--iterations", 3, "--resume").exit_code == 0
    strict = json.loads((out / "result.json").read_text(), parse_constant=pytest.fail)
    assert strict["training"]["steps"] == 3 * 24 * 4 and strict["evaluation"]["seconds"] is None, "nobody arrives"
    assert "has 3 iterations already: only evaluating" in invoke(*common, "--iterations", 2, "--resume").output
    for option in ("--num-envs", "--iterations", "--episodes"):
        assert option in invoke(option, 0).output
    if not torch.cuda.is_available():
        assert "there is no GPU for cuda" in invoke("--device", "cuda").output
    missing = invoke("--out", tmp_path / "nowhere", "--resume")
    assert missing.exit_code == 2 and "leave --resume out" in missing.output


@pytest.mark.slow(1)
def test_an_export_that_acts_otherwise_is_refused(tmp_path, monkeypatch):
    runner = make_runner(tmp_path, "blind")
    nav_export.export(runner, tmp_path)
    run = nav_export._run_onnx
    monkeypatch.setattr(nav_export, "_run_onnx", lambda path, observation: run(path, observation) + 0.01)
    with pytest.raises(ValueError, match="policy.onnx: must act as the policy does, got an error of 0.01"):
        nav_export.export(runner, tmp_path)


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
        "import os, torch, tests.training.test_nav as t\n"
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
