"""One environment of Isaac Lab for all tests: a process has one simulation at a time, and it takes 20 s to start."""

import pytest


@pytest.fixture(scope="session")
def env():
    from benchmarks.quality.isaac_lab.task import AllSensorsCfg, make_env

    env = make_env(AllSensorsCfg())
    yield env
    env.close()


@pytest.fixture(scope="session")
def terms(env):
    from benchmarks.quality.isaac_lab.task import find_terms

    return find_terms(env)
