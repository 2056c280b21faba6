"""Bundles: recorded, exported, checked, and refused where their parts do not fit."""

import json
import shutil

import numpy as np
import pytest
import torch
from click.testing import CliRunner

import torchelev as te
from tests.helpers import pose, random_clouds
from torchelev.app.cli import main
from torchelev.runtime.bundle.bundle import read_bundle
from torchelev.runtime.bundle.recording import CONFIG, EPISODE, OBSERVATION, POLICY, Recorder

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

NAMES = ("speed", "turn", "slope")
SCAN = te.HeightScan.points([(0.2, 0.1), (-0.3, 0.0), (0.5, 0.5)], clip=1.0)
FEET = te.HeightScan.feet(num_feet=2, rings=[(0.1, 4)], reach=0.3)
IMAGE = te.MapImage(length_x=0.8, length_y=0.8, resolution=0.1)
STEPS = 6


def save_policy(path, *sizes, weight=0.5):
    """A policy whose action is the weighted sum of its inputs, and its negative."""
    shapes = [[1, *np.atleast_1d(size).tolist()] for size in sizes]
    infos = [onnx.helper.make_tensor_value_info(f"obs_{k}", 1, shape) for k, shape in enumerate(shapes)]
    nodes, parts = [], []
    for k, _ in enumerate(sizes):
        nodes.append(onnx.helper.make_node("Flatten", [f"obs_{k}"], [f"flat_{k}"]))
        nodes.append(onnx.helper.make_node("ReduceSum", [f"flat_{k}"], [f"sum_{k}"], keepdims=1))
        parts.append(f"sum_{k}")
    nodes.append(onnx.helper.make_node("Sum", parts, ["total"]))
    nodes.append(onnx.helper.make_node("Mul", ["total", "weights"], ["actions"]))
    weights = onnx.helper.make_tensor("weights", 1, [2], [weight, -weight])
    out = onnx.helper.make_tensor_value_info("actions", 1, [1, 2])
    graph = onnx.helper.make_graph(nodes, "policy", infos, [out], [weights])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)])
    onnx.save(onnx.helper.make_model(graph, opset_imports=model.opset_import, ir_version=8), str(path))


def record(folder, groups, cfg=None, env=1, **more):
    """An episode of one of two environments, with a reset, a step without an update, and one of two updates."""
    emap = te.ElevationMap(cfg or te.ElevationMapConfig(grid=te.GridConfig(resolution=0.05, length_x=3, length_y=3)), 2)
    rng = np.random.default_rng(0)
    with Recorder(emap, groups, env) as recorder:
        for step in range(STEPS):
            T = torch.cat([pose((0.1 * step, 0, 0.8)), pose((0, 0.1 * step, 0.7), yaw=0.1 * step)])
            if step == 3:
                emap.reset(torch.tensor([1]))
            for _ in range({2: 0, 4: 2}.get(step, 1)):
                emap.update(random_clouds(rng, T, 300), T, T, torch.tensor([0.1, 0.2]), **more)
            feet = torch.from_numpy(rng.uniform(-0.2, 0.2, (2, 2, 3)))
            values = {"body": torch.from_numpy(rng.normal(size=(2, 3)).astype(np.float32))}
            values["scan"], values["feet"] = SCAN(emap, T)[0], FEET(emap, T, feet)[0]
            values["image"] = IMAGE(emap, T)
            observation = {name: values[name] for name in groups}
            total = sum(value.flatten(1).sum(1) for value in observation.values())
            recorder.step(observation, torch.stack([0.5 * total, -0.5 * total], 1), T, feet)
    recorder.write(folder)
    assert "update" not in vars(emap)  # as it was


@pytest.fixture
def run(tmp_path):
    """A run of a policy over a height scan around the base and one around the feet."""
    folder = tmp_path / "run"
    folder.mkdir()
    record(folder, {"body": NAMES, "scan": SCAN, "feet": FEET})
    save_policy(folder / POLICY, 3 + SCAN.num_points + FEET.num_points)
    return folder


def test_a_recording_refuses_channels_by_name():
    grid = te.GridConfig(resolution=0.05, length_x=3, length_y=3)
    plain, colored = te.ElevationMapConfig(grid=grid), te.ElevationMapConfig(grid=grid, channels={"rgb": "color"})
    for group in (te.HeightScan.grid(channels=("rgb",)), te.MapImage(channels=("rgb",))):
        words = r"groups.scan.channels: must read no channels, which bundles do not hold, got \('rgb',\)"
        with pytest.raises(ValueError, match=words):
            Recorder(te.ElevationMap(plain), {"body": NAMES, "scan": group})
    with pytest.raises(ValueError, match="emap.cfg.channels: must be empty, as bundles hold heights alone"):
        Recorder(te.ElevationMap(colored), {"body": NAMES})


def test_a_run_that_reads_channels_is_refused(run, tmp_path):
    described = json.loads((run / OBSERVATION).read_text())
    described["groups"][1]["layout"]["channels"] = ["rgb"]
    (run / OBSERVATION).write_text(json.dumps(described))
    assert "groups.scan.channels: must read no channels" in invoke("export", run, "--out", tmp_path / "out", code=2)


def invoke(*arguments, code=0):
    result = CliRunner().invoke(main, [str(argument) for argument in arguments])
    assert result.exit_code == code, result.output
    return result.output


def test_a_bundle_agrees_in_python_the_c_library_and_onnxruntime(library, run, tmp_path):
    assert "6 steps of the groups body, scan, feet" in invoke("export", run, "--out", tmp_path / "bundle")
    lines = invoke("check", tmp_path / "bundle").splitlines()
    assert [line.split(":")[0] for line in lines] == ["same"] * 3
    assert "largest difference 0" in lines[1]  # to the bit
    invoke("export", run, "--out", tmp_path / "bundle")  # again


def test_one_input_for_each_group_with_an_image(run, tmp_path):
    record(run, {"body": NAMES, "image": IMAGE, "scan": SCAN})
    save_policy(run / POLICY, 3, IMAGE.shape, 3)
    invoke("export", run, "--out", tmp_path / "bundle")
    lines = invoke("check", tmp_path / "bundle").splitlines()
    assert [line.split(":")[0] for line in lines] == ["same"] * 3


def test_a_map_with_levels_and_an_image_of_the_clearance(library, run, tmp_path, monkeypatch):
    image = te.MapImage(length_x=0.8, length_y=0.8, resolution=0.1, layers=("elevation", "clearance"))
    monkeypatch.setitem(globals(), "IMAGE", image)
    grid = te.GridConfig(resolution=0.05, length_x=3, length_y=3)
    record(run, {"body": NAMES, "image": image}, te.ElevationMapConfig(grid=grid, levels=te.LevelsConfig()))
    save_policy(run / POLICY, 3, image.shape)
    invoke("export", run, "--out", tmp_path / "bundle")
    lines = invoke("check", tmp_path / "bundle").splitlines()
    assert [line.split(":")[0] for line in lines] == ["same"] * 3 and "largest difference 0" in lines[1]
    described = json.loads((run / OBSERVATION).read_text())
    assert described["groups"][1]["image"]["max_clearance"] == 3.0
    with pytest.raises(ValueError, match="groups.scan: must scan no ceilings, which bundles do not hold"):
        Recorder(te.ElevationMap(num_envs=1), {"scan": te.HeightScan.grid(surface="ceiling")})


def test_what_differs_is_named_with_the_figure(library, run, tmp_path):
    save_policy(run / POLICY, 3 + SCAN.num_points + FEET.num_points, weight=0.75)
    with np.load(run / EPISODE) as arrays:
        arrays = dict(arrays)
    arrays["step_group_scan"][4, 1] += 0.25
    np.savez(run / EPISODE, **arrays)
    invoke("export", run, "--out", tmp_path / "bundle")
    lines = invoke("check", tmp_path / "bundle", code=1).splitlines()
    assert lines[0].startswith("DIFFERS: the map in Python") and lines[1].startswith("same")
    assert "scan first differs at step 4, value 1:" in lines[0] and "0.25 apart; 1 of 3 values do" in lines[0]
    assert lines[2].startswith("DIFFERS: the policy in onnxruntime") and "action first differs at step 0" in lines[2]


def change_json(path, change):
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


def other_points(values):
    values["groups"][1]["layout"]["pattern"].pop()


def far_points(values):
    values["groups"][1]["layout"]["pattern"][0] = [9.0, 0.0]


DAMAGE = {
    "no policy": (lambda run: (run / POLICY).unlink(), f"{POLICY}: must be there"),
    "no episode": (lambda run: (run / EPISODE).unlink(), f"{EPISODE}: must be there"),
    "bad config": (
        lambda run: (run / CONFIG).write_text('{"grid": {"size": 3}}'),
        "config.grid.size: is not a setting",
    ),
    "bad episode": (lambda run: (run / EPISODE).write_bytes(b"PK"), f"{EPISODE}: damaged"),
    "other points": (lambda run: change_json(run / OBSERVATION, other_points), "group scan: must be (6, 2)"),
    "far points": (lambda run: change_json(run / OBSERVATION, far_points), "group scan: pattern: must lie in the map"),
    "no group": (lambda run: change_json(run / OBSERVATION, lambda v: v.update(groups=[])), "must be a list of groups"),
    "version": (
        lambda run: change_json(run / OBSERVATION, lambda v: v.update(torchelev_bundle=9)),
        "must be of version 1",
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_parts_that_do_not_fit_are_refused_by_name(run, tmp_path, name):
    damage, words = DAMAGE[name]
    damage(run)
    assert words in invoke("export", run, "--out", tmp_path / "bundle", code=2)
    assert not (tmp_path / "bundle").exists()


def test_what_changed_after_the_export_is_refused(run, tmp_path):
    bundle = tmp_path / "bundle"
    invoke("export", run, "--out", bundle)
    change_json(bundle / CONFIG, lambda values: values["drift"].update(gain=0.5))
    assert "map.json: must be as it was exported, got another hash" in invoke("check", bundle, code=2)
    shutil.rmtree(bundle)
    assert "bundle.json: cannot be read" in invoke("check", bundle, code=2)
    assert "no libtorchelev of this machine" in invoke(
        "check", _exported(run, bundle), "--library", run / POLICY, code=2
    )


def _exported(run, bundle):
    invoke("export", run, "--out", bundle)
    return bundle


def test_a_policy_of_other_inputs_is_refused(run, tmp_path):
    save_policy(run / POLICY, 7)
    invoke("export", run, "--out", tmp_path / "bundle")
    assert "policy.onnx, obs_0: must take (14,) values" in invoke("check", tmp_path / "bundle", code=2)


def test_other_files_are_not_replaced(run, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    assert "must be a new folder or an older bundle" in invoke("export", run, "--out", tmp_path / "mine", code=2)
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]


def test_a_missing_group_is_named(run):
    with Recorder(te.ElevationMap(), {"scan": SCAN}) as recorder:
        with pytest.raises(ValueError, match=r"observation.scan: expected \(B, \*\(3,\)\), got None"):
            recorder.step({}, torch.zeros(1, 2), torch.eye(4)[None])
        with pytest.raises(ValueError, match="must have recorded a step"):
            recorder.write(run)


def test_clouds_of_other_sizes_and_a_reset_without_an_update_are_recorded(library, run, tmp_path):
    emap = te.ElevationMap(te.ElevationMapConfig(grid=te.GridConfig(resolution=0.05, length_x=3, length_y=3)))
    T = pose((0.0, 0.0, 0.8))
    with Recorder(emap, {"scan": SCAN}) as recorder:
        for step, number in enumerate((300, 200, 0, 250)):
            if step == 2:
                emap.reset()
            else:
                emap.update(random_clouds(np.random.default_rng(step), T, number), T, T, 0.1)
            scan = SCAN(emap, T)[0]
            recorder.step({"scan": scan}, 0.5 * scan.sum(1, keepdim=True) * torch.tensor([1.0, -1.0]), T)
        with pytest.raises(NotImplementedError, match="emap.initialize: is not recorded"):
            emap.initialize(torch.zeros(1, 3, 3))
    recorder.write(run)
    save_policy(run / POLICY, 3)
    invoke("export", run, "--out", tmp_path / "bundle")
    lines = invoke("check", tmp_path / "bundle").splitlines()
    assert [line.split(":")[0] for line in lines] == ["same"] * 3


def test_an_export_that_was_interrupted_is_made_again(run, tmp_path):
    bundle = tmp_path / "bundle"
    invoke("export", run, "--out", bundle)
    (bundle / "bundle.json").unlink()
    invoke("export", run, "--out", bundle)


def test_a_file_that_is_no_policy_is_refused(run, tmp_path):
    (run / POLICY).write_bytes(b"no model")
    invoke("export", run, "--out", tmp_path / "bundle")
    assert "policy.onnx: cannot be read" in invoke("check", tmp_path / "bundle", code=2)


def test_the_episode_is_that_of_its_environment(run, tmp_path):
    invoke("export", run, "--out", tmp_path / "bundle")
    bundle = read_bundle(tmp_path / "bundle")
    updates = [list(bundle.updates(step)) for step in range(bundle.num_steps)]
    assert [len(u) for u in updates] == [1, 1, 0, 1, 2, 1]
    assert [bool(one["resets"]) for u in updates for one in u] == [True, False, True, False, False, False]
    assert all(one["dt"] == pytest.approx(0.2) for u in updates for one in u)
