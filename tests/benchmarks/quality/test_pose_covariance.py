"""The benchmark of uncertain poses runs, with the covariance and without."""

import pytest

from benchmarks.quality import pose_covariance


@pytest.mark.slow(3)
def test_a_covariance_makes_the_map_less_certain():
    given, withheld = (
        pose_covariance.walk("flat", "miki_2022", with_covariance, 4, 14, 0) for with_covariance in (True, False)
    )
    assert given.std > 2 * withheld.std and 0 <= withheld.inside <= given.inside <= 1


def test_the_table_has_both():
    given, withheld = ({"inside": share, "error": 0.01, "std": std} for share, std in ((0.95, 0.02), (0.5, 0.003)))
    text = pose_covariance.table({"rows": [{"preset": "ame_2", "ground": "flat", "with": given, "without": withheld}]})
    assert text.endswith("| ame_2 | flat | 95.0 % | 10.0 | 20.0 | 50.0 % | 3.0 |")
