"""The time of a training step: its parts, and its table."""

import dataclasses

import pytest

from tests.envs.quadruped.cases import CFG
from training.quadruped import step_time, train


@pytest.mark.slow(8)
def test_the_parts_are_within_the_whole():
    def make_runner(*arguments):
        config = dataclasses.replace(CFG, episode_length=0.5)
        return train.make_runner(*arguments, compiled=False, config=lambda: config)

    rows = {row["perception"]: row for row in step_time.measure(3, 1, make_runner)}
    for name, row in rows.items():
        ms = row["ms"]
        assert 0 < sum(ms[part] for part in step_time.PARTS) < ms["whole"]
        assert (ms["rays"] > 0) == (ms["map"] > 0) == (name == "map")
        assert row["steps_per_s"] == round(3000 / ms["whole"])
        assert min(ms[part] for part in ("physics", "scan", "critic's scan", "policy", "learning")) > 0


def test_the_table_has_the_rest_and_the_ratio():
    def row(perception, whole):
        parts = dict.fromkeys(step_time.PARTS, 1.0) | {"whole": whole}
        return {"perception": perception, "ms": parts, "steps_per_s": 1000}

    lines = step_time.table({"num_envs": 256, "rows": [row("map", 30.0), row("truth", 20.0)]}).split("\n")
    assert lines[0] == "| 256 robots | map | truth |"
    assert lines[-4:-2] == ["| all else | 23.0 | 13.0 |", "| **whole step** [ms] | 30.0 | 20.0 |"]
    assert lines[-2:] == [
        "| **by that with the truth** | 1.50 | 1.00 |",
        "| **environment steps / s** | 1,000 | 1,000 |",
    ]
