"""Configs of elevation_mapping_cupy: what is taken over, what a note says, and what is refused."""

import numpy as np
import pytest
import torch

from torchelev import ChannelConfig, ElevationMap, ElevationMapConfig, GridConfig
from torchelev.io.em_cupy import load_config
from torchelev.io.em_cupy.parameters import NODE_PARAMETERS, PARAMETERS, SWITCHES
from torchelev.traversability.paper_filter import SHAPES

CORE = """
resolution: 0.05
map_length: 6.0
sensor_noise_factor: 0.05
min_valid_distance: 0.4
max_height_range: 0.8
ramped_height_range_a: 0.25
overlap_clear_range_xy: 4.0
overlap_clear_range_z: 2.0
max_ray_length: 7.5
min_height_drift_cnt: 80
wall_num_thresh: 20
drift_compensation_alpha: 0.5
map_frame: odom
"""
PLUGINS = """
min_filter: {enable: True, fill_nan: False, layer_name: low, extra_params: {dilation_size: 1, iteration_n: 30}}
smooth_filter: {enable: True, layer_name: smooth, extra_params: {input_layer_name: low}}
inpainting: {enable: False, layer_name: inpaint, extra_params: {method: telea}}
erosion: {enable: True, layer_name: safe, extra_params: {input_layer_name: traversability, reverse: True}}
features_pca: {enable: True, layer_name: pca, extra_params: {}}
"""
SENSOR = """
pointcloud_channel_fusions: {rgb: color, person: class_average, default: average}
image_channel_fusions: {rgb: color, feat_.*: exponential}
subscribers: {front: {topic_name: /points, data_type: pointcloud}}
"""


@pytest.fixture
def write(tmp_path):
    def write(name, text):
        (tmp_path / name).write_text(text)
        return tmp_path / name

    return write


def test_settings_that_mean_the_same_are_taken_over(write):
    cfg, _ = load_config(write("core.yaml", CORE))
    assert cfg.grid == GridConfig(resolution=0.05, length_x=6.0, length_y=6.0)
    assert (cfg.sensor.min_distance, cfg.sensor.exclusion.height, cfg.sensor.exclusion.slope) == (0.4, 0.8, 0.25)
    assert (cfg.overlap.radius, cfg.overlap.height, cfg.raycast.max_range) == (2.0, 2.0, 7.5)
    assert (cfg.drift.min_points, cfg.drift.gain, cfg.fusion.edges.min_points) == (80, 0.5, 20)
    assert cfg.sensor.noise_factor == ElevationMapConfig().sensor.noise_factor


def test_a_note_says_what_differs(write):
    notes = load_config(write("core.yaml", CORE + "cleanup_step: 0.1\n")).notes
    for words in (
        "sensor_noise_factor = 0.05: grows with the squared depth, and is compared as a standard deviation; the",
        "overlap_clear_range_xy = 4.0: is a side there, and a radius here: halved",
        "cleanup_step = 0.1: has no equal: one accepted ray removes a cell",
        "map_frame: settings of the node",
    ):
        assert any(note.startswith(words) for note in notes), words
    assert not any(note.startswith(("resolution", "max_height_range")) for note in notes)


def test_switches_leave_stages_out(write):
    text = (
        "".join(f"{name}: false\n" for name in SWITCHES) + "max_drift: 0.2\nmax_ray_length: 5.0\nwall_num_thresh: 9\n"
    )
    cfg, _ = load_config(write("core.yaml", text))
    assert cfg.drift is cfg.raycast is cfg.overlap is cfg.fusion.edges is None
    cfg, _ = load_config(write("core.yaml", "".join(f"{name}: true\n" for name in SWITCHES)))
    assert cfg == ElevationMapConfig()


def test_a_length_that_is_not_whole_is_rounded(write):
    cfg, notes = load_config(write("core.yaml", "resolution: 0.05\nmap_length: 6.02\n"))
    assert cfg.grid.length_x == pytest.approx(6.0) and "map_length = 6.02: became 6 m, 120 whole cells" in notes


def test_plugins_become_filters(write):
    cfg, notes = load_config(write("core.yaml", CORE), write("plugins.yaml", PLUGINS))
    assert [(step.layer, step.filter, step.inputs, dict(step.settings)) for step in cfg.filters] == [
        ("low", "em_cupy_min_filter", ("elevation",), {"dilation_size": 1, "iteration_n": 30}),
        ("smooth", "em_cupy_smooth_filter", ("low",), {}),
        ("safe", "em_cupy_erosion", ("traversability",), {"reverse": True}),
    ]
    assert any(note.startswith("plugin features_pca, layer pca: has no equal") for note in notes)
    emap = ElevationMap(cfg)
    assert emap.layer("smooth").shape == (1, 120, 120)


def test_channels_by_the_first_rule_that_fits(write):
    files = write("core.yaml", CORE + "average_weight: 0.25\n"), None, write("sensor.yaml", SENSOR)
    cfg, _ = load_config(*files, channels=["feat_0", "stone"])
    assert cfg.channels == {
        "rgb": ChannelConfig(kind="color"),
        "person": ChannelConfig(kind="exponential", rate=0.75),
        "feat_0": ChannelConfig(kind="exponential", rate=1.0),
        "stone": ChannelConfig(kind="exponential", rate=1.0),
    }


def test_files_of_ros_2_have_names_of_nodes_around_them(write):
    inner = (CORE + PLUGINS + SENSOR).replace("\n", "\n    ")
    ros2 = load_config(write("core.yaml", f"elevation_mapping:\n  ros__parameters:\n    {inner}\n"))
    ros1 = load_config(*(write(f"{k}.yaml", text) for k, text in enumerate((CORE, PLUGINS, SENSOR))))
    assert ros2.cfg == ros1.cfg and set(ros2.notes) == set(ros1.notes)
    only_plugins = write("plugins.yaml", "/node:\n  ros__parameters:" + PLUGINS.replace("\n", "\n    "))
    assert load_config(write("core.yaml", CORE), only_plugins).cfg.filters == ros1.cfg.filters


def test_a_converted_map_takes_clouds_with_colours(write):
    emap = ElevationMap(load_config(write("core.yaml", CORE), None, write("sensor.yaml", SENSOR)).cfg)
    T = torch.eye(4)[None]
    T[:, 2, 3] = 1.0
    points = torch.tensor([[[0.52, 0.03, -1.0]]])
    emap.update(points, T, T, dt=0.1, features={"rgb": torch.tensor([[[0.25, 0.5, 1.0]]])})
    assert emap.layer("rgb")[0, :, 70, 60].tolist() == pytest.approx([0.25, 0.5, 1.0])


@pytest.mark.parametrize(
    "text, words",
    [
        (
            "resolutoin: 0.05\n",
            "resolutoin: is no parameter of elevation_mapping_cupy, got 0.05; correct it, or remove it",
        ),
        ("max_ray_length: far\n", "max_ray_length: must be a number, got 'far'"),
        ("min_valid_distance: -1.0\n", "sensor.min_distance, max_distance: must be ordered"),
        ("sharpen: {layer_name: sharp}\n", "sharpen: must be a plugin: min_filter, .*, got sharpen"),
        ("inpainting: {layer_name: a, extra_params: {method: fast}}\n", "must be telea or ns, got 'fast'"),
        (
            "min_filter: {layer_name: a, extra_params: {size: 3}}\n",
            "min_filter.size: is no setting of the plugin, got 3",
        ),
        (
            "image_channel_fusions: {rgb: colour}\n",
            "image_channel_fusions.rgb: must be one of color, average, .*got colour",
        ),
    ],
)
def test_refuses_what_the_package_does_not_have(write, text, words):
    with pytest.raises(ValueError, match=words):
        ElevationMap(load_config(write("core.yaml", "map_length: 6.0\nresolution: 0.05\n" + text)).cfg)


def test_every_rule_names_a_setting_that_exists():
    settings = ElevationMapConfig().to_dict()
    for name, rule in PARAMETERS.items():
        if rule.convert is not None:
            group = settings
            for part in rule.setting.split("."):
                assert part in group, name
                group = group[part]
        assert rule.note or rule.convert, name
    assert not set(PARAMETERS) & set(NODE_PARAMETERS)


# The mode that computes the same heights ------------------------------------------------------------------------------


def test_same_heights_take_over_what_has_another_meaning_by_default(write):
    cfg, notes = load_config(
        write("core.yaml", CORE + "cleanup_step: 0.3\nmahalanobis_thresh: 1.5\n"), same_heights=True
    )
    assert cfg.sensor.depth.factor == 0.05 and cfg.raycast.steps.validity_per_ray == 0.3
    assert cfg.fusion.averaging.gate_per_variance == 1.5 and cfg.overlap.square.side == 4.0
    assert not any(note.startswith(("mahalanobis_thresh", "cleanup_step")) for note in notes)
    assert any(note.startswith("weight_file: without") for note in notes)


def test_weights_lie_beside_the_file_that_names_them(write, tmp_path):
    path = write("core.yaml", CORE + "weight_file: weights.npz\n")
    with pytest.raises(
        ValueError, match=r"weight_file: must be a file, got .*weights.npz; give its path from the folder"
    ):
        load_config(path, same_heights=True)
    np.savez(tmp_path / "weights.npz", **{name: np.zeros(shape, np.float32) for name, shape in SHAPES.items()})
    cfg, notes = load_config(path, same_heights=True)
    assert cfg.surface.upper_bound.filter_weights == str(tmp_path / "weights.npz")
    assert not any("weight_file" in note for note in notes)


def test_switches_are_true_or_false(write):
    for same_heights in (False, True):
        for value in ("nope", "'false'", "0"):
            with pytest.raises(ValueError, match="enable_drift_compensation: must be true or false"):
                load_config(write("core.yaml", f"enable_drift_compensation: {value}"), same_heights=same_heights)
        off = load_config(write("core.yaml", "enable_drift_compensation: false"), same_heights=same_heights).cfg
        assert off.drift is None


def test_files_in_the_wrong_order_are_refused(write):
    core, plugins = write("core.yaml", CORE), write("plugins.yaml", PLUGINS)
    with pytest.raises(ValueError, match=r"core, .*plugins.yaml: must hold parameters of the map, got min_filter"):
        load_config(plugins)
    with pytest.raises(ValueError, match=r"plugins, .*core.yaml: must hold plugins alone, got resolution"):
        load_config(core, core)


def test_plugins_may_have_names_of_their_own(write):
    text = "low_1: {type: min_filter, enable: True, fill_nan: True, layer_name: low}"
    cfg, notes = load_config(write("core.yaml", CORE), write("plugins.yaml", text))
    assert [(step.layer, step.filter) for step in cfg.filters] == [("low", "em_cupy_min_filter")]
    assert any("fill_nan has no equal" in note for note in notes)


def test_without_rules_channels_have_those_of_the_package(write):
    core = write("core.yaml", CORE)
    cfg = load_config(core, channels=["rgb", "person"]).cfg
    assert (cfg.channels["rgb"].kind, cfg.channels["person"].kind) == ("color", "exponential")
    rules = write("sensor.yaml", "pointcloud_channel_fusions: {rgb: color}\nimage_channel_fusions: {rgb: color}")
    notes = load_config(core, sensor=rules, channels=["person"]).notes
    assert any(note.startswith("channel person: no rule of") for note in notes)


def test_same_heights_count_every_point_for_the_newest_colour(write):
    cfg, notes = load_config(write("core.yaml", CORE), sensor=write("sensor.yaml", SENSOR), same_heights=True)
    rgb = cfg.channels["rgb"]
    assert (rgb.kind, rgb.rate, rgb.is_color) == ("exponential", 1.0, True) and rgb.tolerance > 1e3
    assert not any(note.startswith("channel rgb") for note in notes)


def test_an_odd_number_of_cells_is_told(write):
    notes = load_config(write("core.yaml", "resolution: 0.05\nmap_length: 8.05"), same_heights=True).notes
    assert any("161 cells are an odd number" in note for note in notes)


def test_a_substitution_of_a_launch_file_is_named(write):
    with pytest.raises(ValueError, match="write what the launch file puts there"):
        load_config(write("core.yaml", "resolution: $(arg resolution)"))
