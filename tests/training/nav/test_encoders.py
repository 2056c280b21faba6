"""The encoders of the training: each trains, exports and resumes; a checkpoint of another one is refused."""

import pytest
import torch

import training.nav.train as nav
from envs.terrain_nav.sight import LAYERS
from tests.training.nav.runners import CFG, make_runner, weights
from training.nav.encoders import ENCODERS, encoder_config
from training.nav.export import export
from training.resume import CHECKPOINT


@pytest.mark.slow(5)
@pytest.mark.parametrize("encoder", ENCODERS)
def test_trains_and_exports(tmp_path, encoder):
    runner = make_runner(tmp_path, encoder=encoder)
    before = weights(runner)
    runner.learn(2)
    still = [name for name, value in weights(runner).items() if torch.equal(value, before[name])]
    assert [name.split(".")[-1] for name in still] == ["coordinates"] * (encoder == "attention")
    export(runner, tmp_path)  # which compares the actions


def test_pays_attention_where_the_images_pixels_are():
    runner = make_runner(None, "truth", encoder="attention")
    for model, group in ((runner.alg.actor, "map"), (runner.alg.critic, "truth")):
        encoder = model.encoders[group]
        xy = runner.env.task.sight.crop.xy(torch.eye(4)[None])[0].T.unflatten(-1, (8, 2, 8, 2))
        torch.testing.assert_close(encoder.coordinates[0], xy.mean((2, 4)).flatten(1))
        assert LAYERS[encoder.validity] == "validity"


def test_the_mlp_connects_every_unit_to_every_pixel():
    runner = make_runner(None, "truth", encoder="mlp")
    weight = runner.alg.actor.cnns["map"][0].weight
    image = runner.env.get_observations()["map"]
    assert weight.shape == (128, *image.shape[1:])
    expected = torch.nn.functional.elu(image.flatten(1) @ weight.flatten(1).T + runner.alg.actor.cnns["map"][0].bias)
    torch.testing.assert_close(runner.alg.actor.cnns["map"](image), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.slow(1)
def test_a_checkpoint_of_another_encoder_is_refused(tmp_path):
    make_runner(tmp_path, "blind").learn(1)
    found = torch.load(tmp_path / CHECKPOINT, weights_only=False)
    with pytest.raises(ValueError, match="checkpoint: must be of encoder mlp, got cnn"):
        make_runner(None, "blind", encoder="mlp").resume(tmp_path / CHECKPOINT)
    del found["infos"]["kind"]["encoder"]  # as older ones
    torch.save(found, tmp_path / CHECKPOINT)
    make_runner(None, "blind").resume(tmp_path / CHECKPOINT)


def test_the_command_takes_the_encoder():
    settings = {"compiled": False, "encoder": "attention", "config": lambda **_: CFG}
    runner = nav.make_runner(2, "blind", 0, "cpu", None, **settings)
    assert type(runner.alg.actor).__name__ == type(runner.alg.critic).__name__ == "AttentionModel"
    assert encoder_config("cnn", "map") == encoder_config("cnn", "truth")
