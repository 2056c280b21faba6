"""Deployments of one policy whose scans fill unknown ground by several rules."""

import pytest

from tests.envs.quadruped.cases import CFG
from training.quadruped import fills


@pytest.mark.slow(1)
def test_each_rule_fills_with_other_heights():
    errors = [fills.unknown_error(fills.with_fill(CFG, fill), num_envs=2, steps=12) for fill in fills.FILLS]
    assert all(0 < error < 1 for error in errors) and len({round(error, 6) for error in errors}) == len(errors)


def test_only_the_fill_differs_between_deployments():
    seen = []

    def fake(policy, cfg, perception, episodes, compiled, seed):
        seen.append((cfg.sight.fill, perception, episodes, seed))
        assert fills.with_fill(cfg, "upper_bound") == fills.task_config(held_out=True)
        crossed = fills.FILLS.index(cfg.sight.fill) / 10 + seed / 100
        row = {"crossed": crossed, "fallen": 0.25}
        return {"all": row, "by_kind": {"flat": row, "stairs up": row}}

    text = fills.table(fills.measure((0, 10), 4, fake, lambda cfg, num_envs: 0.123))
    assert seen == [(fill, "map", 4, seed) for fill in fills.FILLS for seed in (0, 10)]
    line = next(line for line in text.splitlines() if "inpaint" in line)
    assert [cell.strip() for cell in line.split("|")[1:-1]] == [
        "`inpaint`", "12.3 cm", "25.0 % (20.0 to 30.0)", "25 %", "25 %", "25 %"
    ]  # fmt: skip
