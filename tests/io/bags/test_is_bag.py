"""Which paths are bags, and which are folders of scans."""

import numpy as np
import pytest

from tests.io.bags.synthetic import write_drive
from torchelev.io.bags import Bag, is_bag


def test_bags_of_all_kinds(tmp_path):
    assert is_bag(write_drive(tmp_path, "ros1", depth=False))
    folder = write_drive(tmp_path, "mcap", depth=False)
    assert is_bag(folder) and is_bag(folder / "drive.mcap")
    (folder / "metadata.yaml").unlink()  # as after a crash
    assert is_bag(folder)


def test_a_metadata_file_of_another_program_is_none(tmp_path):
    (tmp_path / "metadata.yaml").write_text("sensor: lidar\nplace: quarry\n")
    np.save(tmp_path / "0.npy", np.zeros((5, 3)))
    assert not is_bag(tmp_path)


@pytest.mark.parametrize("scans", [".", "scans"])
def test_scans_with_the_map_of_an_earlier_run_beside_them_are_none(tmp_path, scans):
    (tmp_path / scans).mkdir(exist_ok=True)
    np.save(tmp_path / scans / "0.npy", np.zeros((5, 3)))
    (tmp_path / "grown.mcap").touch()
    assert not is_bag(tmp_path)


def test_a_bag_beside_another_programs_metadata_is_read(tmp_path):
    folder = write_drive(tmp_path, "mcap", depth=False)
    (folder / "metadata.yaml").write_text("sensor: lidar\n")
    assert is_bag(folder)
    with Bag(folder) as bag:
        assert len(bag.topics) == 4
