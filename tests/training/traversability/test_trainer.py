"""The fit: its losses, its order of batches, and a resume that makes no difference."""

import os
import signal

import pytest
import torch

from tests.training.traversability.small import made_up
from torchelev.robot import RobotConfig
from torchelev.traversability.net import TraversabilityNet
from training.resume import CHECKPOINT
from training.traversability.trainer import FitConfig, Trainer, losses, mean_over_maps


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
    order = [next(k for k, batch in enumerate(run.batches) if batch is run.batch(n)) for n in range(15)]
    for epoch in (order[:5], order[5:10], order[10:]):
        assert sorted(epoch) == [0, 1, 2, 3, 4]
    assert order[:5] != order[5:10] or order[5:10] != order[10:]


@pytest.mark.slow(1)
def test_training_lowers_the_loss(tmp_path):
    run = trainer(batches=1, steps=20, learning_rate=0.02)
    with torch.no_grad():
        run.net.answer_bias.copy_(torch.tensor([1.0, -2.0]))  # right, but not sure of it
    maps = run.batches[0] = run.batches[0]._replace(label=torch.ones_like(run.batches[0].label))
    first = [loss.item() for loss in losses(run.net, maps)]
    run.run(tmp_path)
    assert all(loss.item() < before - 0.1 for loss, before in zip(losses(run.net, maps), first, strict=True))
    assert (tmp_path / CHECKPOINT).exists() and list(tmp_path.glob("events.out.tfevents*"))


@pytest.mark.slow(3)
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


@pytest.mark.slow(1)
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
