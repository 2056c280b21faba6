"""The benchmark of uncertain poses runs, and tells the covariance or not."""

import pytest

from benchmarks.quality import pose_covariance


@pytest.mark.slow(3)
def test_a_told_covariance_makes_the_map_less_certain():
    told, untold = (pose_covariance.walk("flat", "miki_2022", is_told, 4, 14, 0) for is_told in (True, False))
    assert told.std > 2 * untold.std and 0 <= untold.inside <= told.inside <= 1


def test_the_table_has_both():
    told, untold = ({"inside": share, "error": 0.01, "std": std} for share, std in ((0.95, 0.02), (0.5, 0.003)))
    text = pose_covariance.table({"rows": [{"preset": "ame_2", "ground": "flat", "told": told, "untold": untold}]})
    assert text.endswith("| ame_2 | flat | 95.0 % | 10.0 | 20.0 | 50.0 % | 3.0 |")
