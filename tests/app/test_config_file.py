"""Settings in YAML, and options that override them."""

import pytest

from torchelev.app.config_file import load_config


def test_defaults_are_those_of_the_help():
    grid = load_config(None, None, None).grid
    assert (grid.resolution, grid.length_x, grid.length_y) == (0.1, 20.0, 20.0)


def test_size_is_rounded_up_to_whole_cells():
    grid = load_config(None, resolution=0.3, size=5).grid
    assert (grid.height, grid.width) == (17, 17)


def test_options_override_the_file(tmp_path):
    path = tmp_path / "cfg.yaml"
    path.write_text("grid: {resolution: 0.2, length_x: 4, length_y: 6}\nsensor:\n  noise_factor: 2e-4\nraycast: null\n")
    cfg = load_config(path, None, None)
    assert (cfg.grid.height, cfg.grid.width) == (20, 30) and cfg.raycast is None
    assert cfg.sensor.noise_factor == 2e-4
    grid = load_config(path, 0.5, None).grid
    assert (grid.height, grid.width) == (8, 12)
    grid = load_config(path, None, 3.0).grid
    assert (grid.resolution, grid.height, grid.width) == (0.2, 15, 15)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("sensor: {rang: 3}", r"cfg\.yaml: config\.sensor\.rang"),
        ("grid: 3", r"cfg\.yaml: config\.grid must be a mapping"),
        ("[1, 2]", r"cfg\.yaml: expected settings grouped by stage"),
        ("{grid: [", r"cfg\.yaml: cannot be read as YAML"),
        ("grid: {resolution: -1}", "resolution and size must be positive"),
        ("grid: {resolution: 0.001}", "a map of 400,000,000 cells is too large"),
    ],
)
def test_refuses_bad_files(tmp_path, text, problem):
    (tmp_path / "cfg.yaml").write_text(text)
    with pytest.raises(ValueError, match=problem):
        load_config(tmp_path / "cfg.yaml", None, None)
