"""How often labels and simulation agree."""

import numpy as np
import pytest

from tests.training.traversability.labels.ground import ROBOT, tile


def test_agreement_by_hand():
    from training.traversability.physics import summarize, table

    def row(kind, verdict, stood, limit):
        return {"kind": kind, "verdict": verdict, "stood": stood, "stood_at_limit": limit, "legs_clear": stood}

    result = summarize([
        row("a", "stands", True, False), row("a", "stands", True, True), row("a", "step", True, False),
        row("b", "stands", False, False), row("b", "slope", False, False),
    ])  # fmt: skip
    assert result["all"] == {
        "standing": 3, "not_standing": 2, "stood": 2, "fell": 1, "agreement": 0.6,
        "stood_at_limit": 1, "fell_at_limit": 2, "agreement_at_limit": 0.6,
    }  # fmt: skip
    assert result["by_kind"]["a"]["agreement"] == pytest.approx(2 / 3) and result["legs_clear"] == pytest.approx(2 / 3)
    assert result["by_verdict"]["step"]["fell_at_limit"] == 1
    assert "| a | 2 | 2 | 1 | 1 | 0 | 1 | 66.7 % | 66.7 % |" in table(result)


@pytest.mark.slow(1)
def test_a_tile_gives_stances_of_both_labels():
    pytest.importorskip("mujoco")
    from training.traversability.physics import rows_of_tile

    field = tile(lambda x, y: -1.0 * (x.remainder(1.1) < 0.5), 8.0)
    rows = rows_of_tile(field, "moats", ROBOT, 2, np.random.default_rng(0))
    assert [row["verdict"] == "stands" for row in rows] == [True, False]
    assert [row["stood"] for row in rows] == [True, False]
