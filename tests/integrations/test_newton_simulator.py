"""Maps in Newton itself, on a CPU: `make test-newton` runs this in an environment of its own."""

import numpy as np
import pytest
import torch

pytest.importorskip("newton", reason="needs newton: make test-newton")

import newton
import warp as wp

from tests.docs.markdown import DOCS, code_blocks, run_blocks
from tests.integrations.box_on_plane import errors
from tests.integrations.examples import run_example
from tests.integrations.host import no_sync
from torchelev import ElevationMapConfig, GridConfig, HeightScan
from torchelev.integrations.newton import NewtonCamera, NewtonLidar, NewtonMaps
from torchelev.sim import HeightField, Lidar, surface_of
from torchelev.sim.poses import pose
from torchelev.sim.sensors.casting import cast

CFG = ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=4.0, length_y=4.0))
RAYS = torch.nn.functional.normalize(Lidar(rings=24, azimuths=180).directions.float(), dim=-1)
LIDAR = NewtonLidar(RAYS, pose(torch.tensor([0.0, 0.0, 0.3]).double(), 0.0))
CAMERA = NewtonCamera(64, 48, 1.0, pose(torch.tensor([0.3, 0.0, 0.1]).double(), 0.0, 0.6))
Z_FROM_Y = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # T_body_base in a y-up world
GROUND = -1  # the body of what stands still


@pytest.fixture(scope="module", autouse=True)
def quiet():
    wp.config.quiet = True


def make_model(up="z", worlds=3, leg=False, ground="box"):
    """Worlds with a box for a robot 0.5 m above the ground, on which another box of 0.2 m stands, 1 m ahead."""
    axis = newton.Axis.Z if up == "z" else newton.Axis.Y

    def place(x, z):
        return wp.transform(wp.vec3(x, 0.0, z) if up == "z" else wp.vec3(x, z, 0.0), wp.quat_identity())

    robot = newton.ModelBuilder(up_axis=axis)
    base = robot.add_link(xform=place(0.0, 0.5), label="base")
    robot.add_shape_box(base, hx=0.2, hy=0.1, hz=0.05)
    joints = [robot.add_joint_free(child=base)]
    if leg:
        shank = robot.add_link(label="leg")
        robot.add_shape_capsule(shank, radius=0.03, half_height=0.1)
        joints.append(
            robot.add_joint_fixed(base, shank, parent_xform=wp.transform((0.6, 0.0, -0.3), wp.quat_identity()))
        )
    robot.add_articulation(joints)
    main = newton.ModelBuilder(up_axis=axis)
    main.replicate(robot, worlds, spacing=(0, 0, 0))
    main.add_ground_plane()
    if ground == "box":
        size = {"hx": 0.3, "hy": 0.5, "hz": 0.1} if up == "z" else {"hx": 0.3, "hy": 0.1, "hz": 0.5}
        main.add_shape_box(GROUND, xform=place(1.0, 0.1), **size)
    model = main.finalize(device="cpu")
    state = model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    return model, state


@pytest.mark.parametrize("sensors", [[LIDAR], [CAMERA], [LIDAR, CAMERA]], ids=["lidar", "camera", "both"])
@pytest.mark.parametrize("up", ["z", "y"])
def test_heights_are_those_of_the_world(up, sensors):
    model, state = make_model(up)
    maps = NewtonMaps(model, "base", sensors, CFG, Z_FROM_Y if up == "y" else None)
    for _ in range(3):
        maps.update(state, 0.1)
    for world in range(3):
        found = errors(maps, world)
        assert len(found) > (900 if LIDAR in sensors else 300) and found.max() < 2e-3
    assert maps.emap.diagnose() == []
    values, valid = HeightScan.isaac_lab()(maps.emap, maps.T_map_base)
    assert values.shape == (3, 187) and valid.float().mean() > 0.1


def test_memory_is_shared_in_both_directions():
    model, state = make_model()
    maps = NewtonMaps(model, "base", [LIDAR, CAMERA], CFG)
    maps.update(state, 0.1)
    lidar, camera = (reader._cast for reader in maps._readers)
    assert lidar._arrays["out_dist"].ptr == lidar._distance.data_ptr()
    assert lidar._arrays["ray_origins"].ptr == lidar._origins.data_ptr()
    assert camera._depth.ptr == wp.to_torch(camera._depth).data_ptr()
    assert wp.to_torch(state.body_q).data_ptr() == state.body_q.ptr


def test_misses_are_no_points():
    model, state = make_model()
    up = NewtonLidar(torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 0, -1]]), LIDAR.T_base_sensor, max_distance=0.2)
    maps = NewtonMaps(model, "base", [up, CAMERA], CFG)
    maps.update(state, 0.1)
    lidar, camera = (reader.read(state, maps.T_map_base) for reader in maps._readers)
    assert lidar.isnan().all(), "nothing above, a wall beyond the range, and the robot itself"
    assert not camera[0].isnan().all(-1).all() and (camera[~camera.isnan()].abs() < 10.1).all()
    sky = NewtonCamera(8, 6, 0.5, pose(torch.tensor([0.0, 0.0, 0.1]).double(), 0.0, -1.0))
    assert NewtonMaps(model, "base", [sky], CFG)._readers[0].read(state, maps.T_map_base).isnan().all()


@pytest.mark.parametrize("sensor", [LIDAR, CAMERA], ids=["lidar", "camera"])
def test_the_robots_own_links_are_left_out(sensor):
    model, state = make_model(leg=True)
    heights = {}
    for keep_own in (False, True):
        maps = NewtonMaps(model, "base", [sensor], CFG, keep_own=keep_own)
        maps.update(state, 0.1)
        heights[keep_own] = errors(maps)
    assert heights[False].max() < 2e-3 and heights[True].max() > 0.05


def test_worlds_move_and_begin_anew_by_themselves():
    model, state = make_model()
    maps = NewtonMaps(model, "base", [LIDAR], CFG)
    poses = wp.to_torch(state.body_q)
    for step in range(10):
        poses[1, 0] = 0.1 * step  # Newton sees what torch writes
        maps.update(state, 0.1)
    assert maps.emap.center[:, 0].tolist() == pytest.approx([0.0, 0.9, 0.0], abs=0.03)
    for world in range(3):
        assert errors(maps, world).max() < 2e-3
    before = maps.emap.layer("elevation")
    maps.reset(mask=torch.tensor([False, True, False]))
    after = maps.emap.layer("elevation")
    assert after[1].isnan().all() and torch.equal(after[::2].nan_to_num(), before[::2].nan_to_num())
    maps.reset()
    assert maps.emap.layer("elevation").isnan().all()


def test_a_robot_that_falls_in_the_solver():
    """Poses come from the state after each step; the map stays where the ground is."""
    model, state = make_model()
    solver, following, control = newton.solvers.SolverXPBD(model), model.state(), model.control()
    maps = NewtonMaps(model, "base", [CAMERA, LIDAR], CFG)
    pipeline = newton.CollisionPipeline(model)
    contacts = pipeline.contacts()
    for _ in range(100):
        state.clear_forces()
        pipeline.collide(state, contacts)
        solver.step(state, following, control, contacts, 0.005)
        state, following = following, state
        maps.update(state, 0.005)
    assert float(maps.T_map_base[0, 2, 3]) < 0.2, "it lies on the ground"
    assert errors(maps).median() < 1e-3 and errors(maps).quantile(0.9) < 5e-3


@pytest.fixture(scope="module")
def rough():
    """Heights (H, W) [m], x ahead, every 0.1 m of 4 m."""
    rng = np.random.default_rng(0)
    return rng.uniform(0.0, 0.15, (41, 41)).astype(np.float32)


def add_ground(main, heights, kind):
    """The same samples as a height field, whose rows run along y, or as a mesh with one of the diagonals."""
    if kind == "heightfield":
        ground = newton.Heightfield(heights.T, 41, 41, hx=2.0, hy=2.0)
        return main.add_shape_heightfield(heightfield=ground)
    x, y = np.meshgrid(np.linspace(-2, 2, 41), np.linspace(-2, 2, 41), indexing="ij")
    points = np.stack([x, y, heights], -1).reshape(-1, 3).astype(np.float32)
    a = (np.arange(40)[:, None] * 41 + np.arange(40)).ravel()
    b, c, d = a + 41, a + 42, a + 1  # along x, across, along y
    corners = [[a, b, c], [a, c, d]] if kind == "rising" else [[a, b, d], [b, c, d]]
    indices = np.concatenate([np.stack(one, -1) for one in corners]).ravel().astype(np.int32)
    return main.add_shape_mesh(GROUND, mesh=newton.Mesh(points, indices, compute_inertia=False))


@pytest.mark.parametrize("kind", ["heightfield", "rising", "falling"])
def test_rays_meet_the_ground_of_our_own_casts(rough, kind):
    """To the millimetre with the same diagonal; with the other one they differ."""
    main = newton.ModelBuilder()
    main.begin_world()
    body = main.add_body(xform=wp.transform((0.3, -0.2, 0.8), wp.quat_identity()), label="base")
    main.add_shape_sphere(body, radius=0.01)
    main.end_world()
    add_ground(main, rough, kind)
    model = main.finalize(device="cpu")
    above = pose(torch.tensor([0.0, 0.0, 0.1]).double(), 0.0)
    maps = NewtonMaps(model, "base", [NewtonLidar(RAYS, above, max_distance=1.6)], CFG)
    points = maps._readers[0].read(model.state(), maps.T_map_base)[0]
    hit = ~points.isnan().any(-1)
    assert hit.sum() > 1000
    distance = torch.linalg.vector_norm(points, dim=-1)[hit].double()
    origin = (maps.T_map_base @ above)[:, :3, 3].float()
    within = {}
    for diagonal in ("rising", "falling"):
        field = HeightField(torch.from_numpy(rough)[None], 0.1, "triangles", diagonal)
        ours = cast(field, torch.zeros(1, dtype=torch.int64), origin, RAYS[None], 1.7)[0][hit].double()
        within[diagonal] = float(((distance - ours).abs() < 1e-3).double().mean())
    same = surface_of("newton_rays")["diagonal"] if kind == "heightfield" else kind
    assert within.pop(same) > 0.995 and within.popitem()[1] < 0.6


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("trunk", [LIDAR]), "base: must be a body of each of the 3 worlds, once, got 'trunk' in worlds"),
        (("base", []), "sensors: must not be empty"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        NewtonMaps(make_model()[0], *arguments)


def test_axes_and_rays_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="base: must have its z axis upwards at the start, got 'base': 0.00"):
        NewtonMaps(make_model("y")[0], "base", [LIDAR])
    with pytest.raises(ValueError, match="sensors: number 1 must see more than the robot itself"):
        NewtonMaps(make_model()[0], "base", [LIDAR, NewtonLidar(RAYS, torch.eye(4))])
    with pytest.raises(ValueError, match="directions: must be unit vectors"):
        NewtonLidar(2 * RAYS, torch.eye(4))
    with pytest.raises(ValueError, match="fov: must lie in"):
        NewtonCamera(8, 6, 60.0, torch.eye(4))


def test_the_page_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = DOCS / "howto/newton.md"
    run_blocks(path, [block for block in code_blocks(path.read_text()) if block.language == "python"])


def test_a_step_does_not_wait_for_the_device():
    model, state = make_model()
    maps, scan = NewtonMaps(model, "base", [LIDAR, CAMERA], CFG), HeightScan.isaac_lab()
    maps.update(state, 0.02)
    scan(maps.emap, maps.T_map_base)
    with no_sync():
        maps.update(state, 0.02)
        scan(maps.emap, maps.T_map_base)
        maps.reset(mask=torch.tensor([True, False, False]))
    with pytest.raises(AssertionError, match="waits for the device"), no_sync():
        maps.T_map_base.max().item()


def test_the_example_runs(tmp_path):
    assert "height scans (3, 187)" in run_example("newton_maps", tmp_path)
