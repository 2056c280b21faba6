"""rsl-rl's model with attention: its groups, its normalisation, a training step, its exports, and what it refuses."""

import io
import logging
import warnings

import numpy as np
import pytest
import torch

pytest.importorskip("rsl_rl")

from rsl_rl.models import MLPModel
from rsl_rl.utils import resolve_callable
from tensordict import TensorDict

from torchelev.encoders.rsl_rl import AttentionModel

B = 6
GAUSSIAN = {"class_name": "GaussianDistribution", "init_std": 1.0}
SMALL = {"embed_dim": 16, "num_heads": 4, "hidden_channels": 4}
SCAN = {"scan": SMALL | {"points": "isaac_lab", "validity": "known", "mask_unknown": True}}
IMAGE = {"image": SMALL | {"resolution": 0.1, "kernel_size": 3, "patch": 2, "validity": 1}}
GRID = {"scan": SMALL | {"points": "mjlab", "grid": [11, 17], "kernel_size": 5}}
CASES = {
    "scan": (["policy", "scan", "known"], SCAN),
    "image": (["image", "policy", "command"], IMAGE),
    "grid": (["policy", "command", "scan"], GRID),
    "both": (["policy", "scan", "image", "known"], IMAGE | SCAN),
}


def observations(seed=0, num_envs=B):
    generator = torch.Generator().manual_seed(seed)
    shapes = {"policy": (7,), "command": (3,), "scan": (187,), "known": (187,), "image": (2, 8, 6)}
    obs = {name: torch.randn(num_envs, *shape, generator=generator) for name, shape in shapes.items()}
    obs["known"] = (obs["known"] > 0).float()
    return TensorDict(obs, batch_size=[num_envs])


def make(case="scan", obs_set="actor", **settings):
    groups, attention = CASES[case]
    torch.manual_seed(0)
    settings = {"distribution_cfg": dict(GAUSSIAN), "obs_normalization": True, "hidden_dims": [8]} | settings
    return AttentionModel(observations(), {obs_set: groups}, obs_set, 4, attention_cfg=attention, **settings)


@pytest.fixture(params=CASES)
def model(request):
    """A model of each case whose normaliser has seen something."""
    model = make(request.param)
    model.update_normalization(observations(5, 50))
    return model


def test_the_mlp_gets_the_normalised_proprioception_and_the_encodings(model):
    obs = observations(1)
    state = (torch.cat([obs[name] for name in model.obs_groups], -1) - model.obs_normalizer.mean) / (
        model.obs_normalizer.std + model.obs_normalizer.eps
    )
    parts = [state]
    for name, encoder in model.encoders.items():
        groups = [name, "known"] if model.map_groups[name] == (name, "known") else [name]
        parts.append(encoder(state, [obs[group] for group in groups]))
    expected = model.mlp(torch.cat(parts, -1))
    torch.testing.assert_close(model(obs), expected)
    assert set(model.obs_groups) <= {"policy", "command"} and not set(model.obs_groups) & set(model.map_inputs)


def test_rsl_rl_loads_it_by_its_name():
    groups, attention = CASES["scan"]
    cls = resolve_callable("torchelev.encoders.rsl_rl:AttentionModel")
    model = cls(observations(), {"critic": groups}, "critic", 1, attention_cfg=attention)
    assert isinstance(model, MLPModel) and not model.is_recurrent and model(observations()).shape == (B, 1)


def test_actor_and_critic_of_the_same_groups_share_nothing():
    actor, critic = make("image"), make("image", "critic")
    own = {value.data_ptr() for value in actor.parameters()}
    assert own and not own & {value.data_ptr() for value in critic.parameters()}
    assert torch.equal(actor(observations()), critic(observations()))


def test_acts_in_inference_mode_always_the_same_and_then_learns(model):
    obs = observations(2)
    with torch.inference_mode():
        first, second = model(obs), model(obs)
        torch.manual_seed(3)
        model(obs, stochastic_output=True)
        weights = model.attention(obs)
    assert torch.equal(first, second) and torch.equal(first, model(obs).detach())
    assert all((weight.sum(-1) - 1).abs().max() < 1e-5 for weight in weights.values())
    model.zero_grad()
    model(obs, stochastic_output=True)
    model.get_output_log_prob(first + 0.5).sum().backward()
    assert not [name for name, value in model.named_parameters() if value.grad is None or not value.grad.any()]


def test_tells_where_it_looks(model):
    weights = model.attention(observations())
    assert list(weights) == list(model.encoders)
    for name, weight in weights.items():
        coordinates = model.encoders[name].coordinates[0]
        assert weight.shape == (B, 4, coordinates.shape[-1]) and len(coordinates) == 2
        assert coordinates.shape[-1] == (12 if name == "image" else 187)


@pytest.mark.slow(2)
def test_torchscript_is_the_same(model):
    file = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.script(model.as_jit()), file)
        file.seek(0)
        scripted = torch.jit.load(file)
    obs = observations(3)
    actions = scripted(torch.cat([obs[name] for name in model.obs_groups], -1), [obs[g] for g in model.map_inputs])
    torch.testing.assert_close(actions, model(obs), atol=1e-5, rtol=0)
    scripted.reset()


@pytest.mark.slow(10)
def test_onnx_is_the_same(model, tmp_path):
    reference = pytest.importorskip("onnx.reference")
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    exported, path = model.as_onnx(verbose=False).eval(), tmp_path / "policy.onnx"
    names = {"input_names": exported.input_names, "output_names": exported.output_names}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(exported, exported.get_dummy_inputs(), path, opset_version=18, verbose=False, **names)
    session, obs = reference.ReferenceEvaluator(str(path)), observations(4)
    assert session.input_names == ["obs", *model.map_inputs] and session.output_names == ["actions"]
    for b in range(2):
        one = obs[b : b + 1]
        inputs = [torch.cat([one[name] for name in model.obs_groups], -1), *(one[name] for name in model.map_inputs)]
        named = dict(zip(session.input_names, (value.numpy() for value in inputs), strict=True))
        np.testing.assert_allclose(session.run(None, named)[0], model(one).detach().numpy(), atol=1e-5)


def test_without_a_distribution_it_returns_the_mlps_output():
    model, obs = make("image", distribution_cfg=None, obs_normalization=False), observations()
    expected = model.mlp(model.get_latent(obs))
    assert torch.equal(model(obs), expected)
    state = torch.cat([obs["policy"], obs["command"]], -1)
    torch.testing.assert_close(model.as_jit()(state, [obs["image"]]), expected)


@pytest.mark.parametrize(
    "groups, attention, named",
    [
        (["policy", "scan"], {}, "attention_cfg: must name a map"),
        (["policy"], {"scan": {"points": "mjlab"}}, "attention_cfg: must name some of the groups policy, got 'scan'"),
        (
            ["policy", "scan"],
            {"scan": {"points": [[0.0, 0.0]]}},
            r"attention_cfg\['scan'\].points: expected 187, .*got 1;",
        ),
        (["policy", "scan"], {"scan": {"height": 1}}, r"attention_cfg\['scan'\].settings: must be some of points"),
        (["policy", "scan", "image"], {"scan": {"points": "mjlab"}}, "image: must be a group .B, D., or a map"),
        (["scan"], {"scan": {"points": "mjlab"}}, r"obs_groups\['actor'\]: must hold a group \(B, D\) beside the maps"),
        (
            ["policy", "scan"],
            {"scan": {"points": "mjlab", "validity": "known"}},
            r"attention_cfg\['scan'\].validity: must be one of the groups policy, scan, got 'known'",
        ),
    ],
)
def test_refuses_by_name(groups, attention, named):
    with pytest.raises(ValueError, match=f"^{named}"):
        AttentionModel(observations(), {"actor": groups}, "actor", 4, attention_cfg=attention)
