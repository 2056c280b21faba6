"""The term in mjlab itself, on a CPU: `make test-mjlab` runs this in an environment of its own."""

import copy

import pytest
import torch

pytest.importorskip("mjlab", reason="needs mjlab: make test-mjlab")

from benchmarks.quality import mjlab_task  # noqa: E402
from tests.docs.markdown import DOCS, code_blocks  # noqa: E402
from torchelev import HeightScan, MapImage  # noqa: E402
from torchelev.integrations.mjlab import MapObservation  # noqa: E402


@pytest.fixture(scope="module")
def env():
    env = mjlab_task.make_env(mjlab_task.make_config(num_envs=16))
    yield env
    env.close()


@pytest.fixture(scope="module")
def walked(env):
    return mjlab_task.walk(env, steps=50)


def test_the_policy_reads_the_scan(walked):
    assert walked["observed"].shape == (50, 16, 187)
    torch.testing.assert_close(walked["observed"], walked["ours"] / 5)


def test_a_step_later_the_observation_is_as_it_was(env):
    before = env.observation_manager.compute()["actor"]
    copy_of_it = before.clone()
    env.step(torch.zeros(16, 12))
    torch.testing.assert_close(before, copy_of_it, rtol=0, atol=0)
