"""Training the traversability head: its losses, a resume as if it had never stopped, evaluation, and the command."""

import functools
import json
import os
import signal
from pathlib import Path

import click
import pytest
import torch
from click.testing import CliRunner

import training.traversability.__main__ as training
import training.traversability.evaluate as evaluation
import training.traversability.experiment as experiment
from torchelev.robot import RobotConfig
from torchelev.traversability.net import Rating, TraversabilityNet
from training.traversability.maps.data import DataConfig, MappedTerrain, make_batch
from training.traversability.robot import RobotType
from training.traversability.trainer import CHECKPOINT, FitConfig, Trainer, losses, mean_over_maps

TINY = functools.partial(
    DataConfig, num_maps=2, window=2.0, looks=(2, 2), headings=2, camera_pixels=(16, 12), lidar_rays=(8, 64)
)


def made_up(seed, num_maps=2, cells=14):
    """Maps of noise; what counts here is that they differ."""
    draw = functools.partial(torch.rand, num_maps, cells, cells, generator=torch.Generator().manual_seed(seed))
    layers = [0.3 * draw(), draw() < 0.8, 0.01 * draw(), draw(), draw() < 0.5]
    return MappedTerrain(*layers, draw(), draw() < 0.9, 0.1, RobotConfig(), ("rough",) * num_maps)


def trainer(batches=3, **settings):
    return Trainer([made_up(k) for k in range(batches)], FitConfig(**{"steps": 6, **settings}))


def weights(run):
    return {name: value.clone() for name, value in run.net.state_dict().items()}


def same(a, b):
    return all(torch.equal(value, b[name]) for name, value in a.items())


def test_each_map_counts_as_much_as_another():
    values = torch.tensor([[[1.0, 3.0]], [[5.0, 7.0]], [[9.0, 9.0]]])
    rated = torch.tensor([[[True, True]], [[True, False]], [[False, False]]])
    assert float(mean_over_maps(values, rated)) == pytest.approx((2 + 5) / 2)
    assert float(mean_over_maps(values, torch.zeros_like(rated))) == 0.0


def test_losses_are_cross_entropies_of_the_rated_cells():
    torch.manual_seed(0)
    net, maps = TraversabilityNet(), made_up(0, num_maps=1)
    with torch.no_grad():
        rating = net(*maps.maps, resolution=maps.resolution, robot=maps.robot)
    total, confident, number = 0.0, 0.0, int(maps.rated.sum())
    for i, j in maps.rated[0].nonzero().tolist():
        p, c, y = (float(v[0, i, j]) for v in (rating.traversability, rating.confidence, maps.label))
        total -= float(y * torch.tensor(p).log() + (1 - y) * torch.tensor(1 - p).log())
        right = (p >= 0.5) == (y >= 0.5)
        confident -= float(torch.tensor(c if right else 1 - c).log())
    found = [loss.detach() for loss in losses(net, maps)]
    assert float(found[0]) == pytest.approx(total / number, rel=1e-4)
    assert float(found[1]) == pytest.approx(confident / number, rel=1e-4)
    other = maps._replace(label=torch.where(maps.rated, maps.label, 1 - maps.label))
    assert losses(net, other)[0].item() == float(found[0])


def test_each_batch_comes_once_before_any_comes_again():
    run = trainer(batches=5)
    order = [next(k for k, batch in enumerate(run.batches) if batch is run._batch(n)) for n in range(15)]
    for epoch in (order[:5], order[5:10], order[10:]):
        assert sorted(epoch) == [0, 1, 2, 3, 4]
    assert order[:5] != order[5:10] or order[5:10] != order[10:]


def test_training_lowers_the_loss(tmp_path):
    run = trainer(batches=1, steps=20, learning_rate=0.02)
    with torch.no_grad():
        run.net.answer_bias.copy_(torch.tensor([1.0, -2.0]))  # right, but not sure of it
    maps = run.batches[0] = run.batches[0]._replace(label=torch.ones_like(run.batches[0].label))
    first = [loss.item() for loss in losses(run.net, maps)]
    run.run(tmp_path)
    assert all(loss.item() < before - 0.1 for loss, before in zip(losses(run.net, maps), first, strict=True))
    assert (tmp_path / CHECKPOINT).exists() and list(tmp_path.glob("events.out.tfevents*"))


def test_a_resumed_training_equals_one_that_never_stopped(tmp_path):
    whole = trainer()
    whole.run(tmp_path / "whole")
    first = trainer()
    first.run(tmp_path / "parts", until=2)
    assert not same(weights(first), weights(whole))
    rest = trainer()
    rest.resume(tmp_path / "parts" / CHECKPOINT)
    assert rest.step == 2 and same(weights(rest), weights(first))
    rest.run(tmp_path / "parts")
    assert rest.step == 6 and same(weights(rest), weights(whole))


def test_ctrl_c_ends_after_the_step_and_leaves_a_checkpoint(tmp_path):
    whole, run = trainer(), trainer()
    whole.run(tmp_path / "whole")
    advance = run.advance

    def interrupted():
        if run.step == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return advance()

    run.advance = interrupted
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run.run(tmp_path / "parts")
    assert run.step == 4 and signal.getsignal(signal.SIGINT) is before
    rest = trainer()
    rest.resume(tmp_path / "parts" / CHECKPOINT)
    rest.run(tmp_path / "parts")
    assert same(weights(rest), weights(whole))


@pytest.mark.parametrize("other", [{"steps": 7}, {"seed": 1}, {"batches": 2}, {"learning_rate": 0.1}])
def test_a_checkpoint_of_other_settings_is_refused_before_anything_changed(tmp_path, other):
    trainer().run(tmp_path, until=1)
    run = trainer(**other)
    before = weights(run)
    name = "data" if "batches" in other else next(iter(other))
    with pytest.raises(ValueError, match=f"must be of the same settings, got {name} "):
        run.resume(tmp_path / CHECKPOINT)
    assert same(weights(run), before) and run.step == 0


def test_seeds_differ():
    assert not same(weights(trainer(seed=0)), weights(trainer(seed=1)))
    assert same(weights(trainer(seed=1)), weights(trainer(seed=1)))


def test_a_net_for_one_robot_says_so():
    robot = RobotConfig(length=0.5, width=0.45, foot_radius=0.1)  # beyond the sizes that robots are drawn from
    batches, cfg = [made_up(0)._replace(robot=robot)], FitConfig(steps=1)
    run = Trainer(batches, cfg, robot)
    run.advance()
    for resolution in (0.02, 0.1):
        run.net.require_trained(robot, resolution)
    with pytest.raises(ValueError, match="length: must be within"):
        run.net.require_trained(RobotConfig(), 0.04)
    assert run.settings["robot"]["foot_radius"] == 0.1


def test_nothing_to_train_on_is_refused():
    with pytest.raises(ValueError, match="batches: must not be empty"):
        trainer(batches=0)
    with pytest.raises(ValueError, match="steps: must be a positive number"):
        FitConfig(steps=0)


# The robot as an option -----------------------------------------------------------------------------------------------


def test_a_robot_comes_as_pairs_or_as_a_file(tmp_path):
    convert = functools.partial(RobotType().convert, param=None, ctx=None)
    assert convert("length=0.5, width=0.3") == RobotConfig(length=0.5, width=0.3)
    (tmp_path / "robot.yaml").write_text("length: 0.9\nclearance: 0.4\n")
    assert convert(str(tmp_path / "robot.yaml")) == RobotConfig(length=0.9, clearance=0.4)
    (tmp_path / "list.yaml").write_text("[1, 2]\n")
    wrong = {
        "legs=4": "there is no legs; there are length, width",
        "length=long": "length must be a number",
        "length": "length must be a number",
        "length=0.3": "must not exceed the length",
        "length=-1,width=-2": "must be a positive number",
        str(tmp_path / "none.yaml"): "No such file",
        str(tmp_path / "list.yaml"): "must hold a mapping",
    }
    for text, message in wrong.items():
        with pytest.raises(click.BadParameter, match=message):
            convert(text)


# All of it ----------------------------------------------------------------------------------------------------


@pytest.mark.slow(2)
def test_evaluation_names_heads_subsets_and_kinds(tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "RESOLUTIONS", (0.08,))
    torch.manual_seed(0)
    nets = {"0": TraversabilityNet(), "1": TraversabilityNet()}
    result = evaluation.evaluate(nets, tmp_path, 1, TINY())
    batch = make_batch([1, 0, 0], TINY(), resolution=0.08)
    heads = result["held_out"]["8 cm"]
    assert len(heads) == 2 + 8 and list(heads)[:2] == ["learned (0)", "learned (1)"]
    for values in heads.values():
        assert values["cells"] == int(batch.rated.sum())
        assert values["known"]["cells"] == int((batch.rated & batch.validity).sum())
        assert set(values["kinds"]) == set(batch.kinds)
        assert sum(kind["cells"] for kind in values["kinds"].values()) == values["cells"]
    assert set(result["unseen"]["8 cm"]["learned (0)"]["kinds"]) == {"stepping_stones"}
    assert 0 <= heads["learned (0)"]["confidence"]["calibration_error"] <= 1
    assert "confidence" not in heads["analytic (defaults)"]
    json.loads(json.dumps(result), parse_constant=pytest.fail)


def test_known_cells_are_those_that_are_rated_too():
    maps = made_up(0)
    found = evaluation.metrics([torch.full_like(maps.label, 0.7)], [maps])
    assert found["cells"] == int(maps.rated.sum()) and found["known"]["cells"] == int(
        (maps.rated & maps.validity).sum()
    )


def test_confidence_is_measured_where_the_ground_is_known_and_where_not():
    class Constant:
        def __call__(self, elevation, *layers, **of):
            return Rating(torch.full_like(elevation, 0.9), torch.full_like(elevation, 0.75))

    maps = made_up(0)
    found = evaluation.confidence(Constant(), [maps])
    safe = maps.label >= 0.5
    for name, where in (("known", maps.validity), ("unknown", ~maps.validity)):
        assert found[f"confidence_{name}"] == 0.75
        assert found[f"right_{name}"] == pytest.approx(float(safe[maps.rated & where].float().mean()))
    assert found["calibration_error"] == pytest.approx(abs(0.75 - float(safe[maps.rated].float().mean())))


def head(precision, **others):
    return dict.fromkeys(evaluation.COLUMNS, 0.5) | {"average_precision": precision} | others


def test_the_table_has_seeds_as_a_range_and_of_others_the_best():
    heads = {
        "learned (0)": head(0.8),
        "learned (1)": head(0.9, roc_auc=None),
        "analytic (defaults)": head(0.4),
        "analytic (defaults, footprint)": head(0.6),
    }
    lines = evaluation.table({"held_out": {"2 cm": heads}}).splitlines()
    assert lines[2].startswith("| 2 cm | learned | 0.850 (0.800 to 0.900) | 0.500 (0.500 to 0.500) | 0.500 |")
    assert lines[3].startswith("| 2 cm | analytic (defaults, footprint) | 0.600 |") and len(lines) == 4


def invoke(main, *arguments):
    return CliRunner().invoke(main, [*map(str, arguments)], catch_exceptions=False)


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setattr(training, "DataConfig", TINY)
    monkeypatch.setattr(evaluation, "DataConfig", TINY)
    monkeypatch.setattr(evaluation, "RESOLUTIONS", (0.08,))


@pytest.mark.slow(6)
def test_the_commands_train_evaluate_draw_and_resume(tmp_path, tiny):
    out = tmp_path / "run"
    common = ("--out", out, "--batches", 1, "--exact-batches", 1, "--evaluation-batches", 1, "--steps", 2)
    done = invoke(training.main, *common)
    assert done.exit_code == 0 and "| 8 cm | learned |" in done.output
    result = json.loads((out / "result.json").read_text(), parse_constant=pytest.fail)
    assert result["training"]["steps"] == 2 and result["held_out"]["8 cm"]["learned (run)"]["cells"] > 100
    assert (out / "maps.png").stat().st_size > 5000
    refused = invoke(training.main, *common)
    assert refused.exit_code == 2 and "add --resume" in refused.output
    assert invoke(training.main, *common, "--resume").exit_code == 0, "nothing left: it only evaluates"
    other = invoke(training.main, *common[:-1], 3, "--resume")
    assert other.exit_code == 2 and "must be of the same settings, got steps 2" in other.output

    told = ("--data", out / "data", "--batches", 1, "--out", tmp_path / "evaluation.json")
    again = invoke(evaluation.main, "--weights", out / "weights.pt", *told)
    assert again.exit_code == 0 and "unseen" in again.output
    found = json.loads((tmp_path / "evaluation.json").read_text())
    assert found["held_out"]["8 cm"]["learned (run)"] == result["held_out"]["8 cm"]["learned (run)"]


@pytest.mark.slow(2)
def test_the_command_trains_for_one_robot(tmp_path, tiny, monkeypatch):
    monkeypatch.setattr(training, "finish", lambda *_: None)
    common = ("--out", tmp_path, "--batches", 1, "--exact-batches", 1, "--steps", 1)
    assert invoke(training.main, *common, "--robot", "length=0.5,width=0.45,foot_radius=0.1").exit_code == 0
    assert invoke(training.main, *common, "--resume").exit_code == 2
    found = torch.load(tmp_path / CHECKPOINT, weights_only=True)["settings"]["robot"]
    assert (found["length"], found["width"], found["foot_radius"]) == (0.5, 0.45, 0.1)


def test_the_command_refuses_what_does_not_fit(tmp_path, tiny):
    missing = invoke(training.main, "--out", tmp_path / "nowhere", "--resume")
    assert missing.exit_code == 2 and "leave --resume out" in missing.output
    assert "there is no legs" in invoke(training.main, "--robot", "legs=4", "--out", tmp_path).output
    for option in ("--steps", "--batches", "--evaluation-batches"):
        assert option in invoke(training.main, option, 0).output
    nothing = invoke(evaluation.main, "--weights", tmp_path / "none.pt", "--data", tmp_path)
    assert nothing.exit_code == 2 and "none.pt" in nothing.output


def test_the_experiment_trains_only_what_is_not_finished(tmp_path, monkeypatch):
    trained = []
    monkeypatch.setattr(experiment, "train", lambda seed, *rest: trained.append(seed))
    (tmp_path / "seed-1").mkdir()
    (tmp_path / "seed-1" / "result.json").write_text("{}")
    experiment.train_all(tmp_path, 1, None)
    assert trained == [0, 2]


def test_training_is_told_how_it_was_fixed(tmp_path, monkeypatch):
    commands = []
    monkeypatch.setattr(experiment.subprocess, "run", lambda command, **rest: commands.append(command))
    experiment.train(1, tmp_path / "run", Path("maps"), "length=0.5,width=0.3")
    (tmp_path / "run" / CHECKPOINT).touch()
    experiment.train(1, tmp_path / "run", Path("maps"), None)
    first, second = (" ".join(command) for command in commands)
    assert "--seed 1" in first and "--robot length=0.5,width=0.3" in first and "--resume" not in first
    assert second.endswith("--resume") and "--robot" not in second
