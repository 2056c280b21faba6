"""The figures of the documentation: a scan that is mapped, and the choice of an episode."""

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from torchelev.io.poses import read_poses
from torchelev.sim import Lidar
from torchelev.sim.exact.scenes import boxes


@pytest.mark.slow(3)
def test_a_scan_in_kitti_layout_is_mapped_and_drawn(tmp_path):
    pytest.importorskip("pyvista", reason="renders the surface; pip install 'torchelev[pictures]'")
    import torch

    from docs.figures import surfaces

    pose = np.eye(4)
    pose[2, 3] = 0.6
    points = Lidar(rings=16, azimuths=256).cast(boxes(), torch.from_numpy(pose)).numpy()
    np.column_stack([points, points[:, :1]]).astype(np.float32).tofile(tmp_path / "000000.bin")
    np.savetxt(tmp_path / "poses.txt", pose[:3].reshape(1, 12))
    poses = read_poses(tmp_path / "poses.txt").T_map_sensor
    np.testing.assert_allclose(poses[0], pose)
    elevation = surfaces.map_scan(tmp_path / "000000.bin", poses[0]).layer("elevation")[0]
    assert elevation.isfinite().sum() > 500 and abs(float(elevation.nanmedian())) < 0.02
    surfaces.draw_real_scan(tmp_path / "000000.bin", poses[0], poses[:, :3, 3], tmp_path / "scan.png")
    assert (tmp_path / "scan.png").stat().st_size > 20_000


def test_the_first_episode_is_chosen_that_one_policy_fails_and_the_other_masters():
    pytest.importorskip("rsl_rl")
    from docs.figures.episodes import Outcomes, first_difference

    def ended(*endings):
        return Outcomes(list(endings), [1.0] * len(endings), np.zeros((2, len(endings), 2)), {})

    first = ended("success", "stuck", "fallen", "stuck")
    assert first_difference((first, ended("success", "truncated", "success", "success"))) == 2
    assert first_difference((first, first)) is None


@pytest.mark.slow(8)
def test_a_pair_of_episodes_is_drawn(tmp_path):
    pytest.importorskip("rsl_rl")
    from docs.figures.episodes import draw, run
    from training.nav.evaluate import straight_line

    result = run(straight_line, 4, seed=7, max_steps=60)
    env = min(result.shots)
    assert result.trails.shape[1:] == (4, 2) and 0 < result.seconds[env] <= 12
    draw((result, result), env, tmp_path / "pair.png")
    assert (tmp_path / "pair.png").stat().st_size > 20_000
