"""MuJoCo's rays, rendered depth and height fields: the ground that maps show is the ground that feet stand on."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.integrations.box_on_plane import errors
from torchelev import ElevationMapConfig, GridConfig
from torchelev.gym import MapFeed
from torchelev.integrations.mujoco import MujocoCamera, MujocoRays, height_field
from torchelev.sim import DepthCamera, make_terrain, mount
from torchelev.sim.sensors.casting import cast

mujoco = pytest.importorskip("mujoco")

CFG = ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=4.0, length_y=4.0))
RAYS = DepthCamera(width=64, height=48).directions
SCENE = """
<mujoco><worldbody>
  <geom type="plane" size="10 10 0.1"/>
  <geom type="box" pos="1 0 0.1" size="0.3 0.5 0.1"/>
  <body name="base" pos="0 0 0.5"><freejoint/>
    <geom type="box" size="0.2 0.1 0.05" mass="1"/>
    <camera name="eye" pos="0.25 0 0.05" xyaxes="0 -1 0 0.574 0 0.819" fovy="58"/>
    <camera name="map" pos="0 0 1" projection="orthographic" fovy="2"/>
    <body name="leg" pos="0.6 0.1 -0.3"><geom type="box" size="0.05 0.05 0.1" mass="0.1"/></body>
  </body>
</worldbody></mujoco>"""


@pytest.fixture(scope="module")
def scene():
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return SimpleNamespace(model=model, data=data)


def feed(sensor, data, rays):
    """A feed that has seen the scene three times."""
    sources = {"points": lambda env: sensor.points(env)} if isinstance(sensor, MujocoRays) else {}
    sources = sources or {"depth": lambda env: sensor.depth(env), "intrinsics": sensor.intrinsics}
    poses = {"T_map_sensor": sensor.T_map_sensor, "T_map_base": rays.T_map_body}
    feed = MapFeed(None, **sources, **poses, dt=0.02, cfg=CFG)
    for step in range(3):
        feed.observe(data, torch.tensor([step == 0]), stepped=step > 0)
    return feed


@pytest.fixture(scope="module")
def rays(scene):
    return MujocoRays(scene.model, "base", RAYS, mount(pitch_deg=35.0, x=0.25, z=0.05), max_distance=4.0)


def test_a_feed_of_rays_maps_the_scene(scene, rays):
    found = errors(feed(rays, scene.data, rays))
    assert len(found) > 500 and found.quantile(0.99) < 2e-3


def test_a_feed_of_rendered_depth_maps_the_scene(scene, rays):
    """The z-buffer of the renderer is as exact as the camera's near and far planes allow."""
    try:
        camera = MujocoCamera(scene.model, "eye", 160, 120, max_distance=4.0)
    except Exception as error:
        pytest.skip(f"MuJoCo cannot render here: {error!r}")
    feed_of_depth = feed(camera, scene.data, rays)
    found = errors(feed_of_depth)
    # It shows the leg, too, 0.3 m high, and what is next to it.
    assert len(found) > 500 and found.quantile(0.9) < 0.01
    by_rays = feed(rays, scene.data, rays).emap.layer("elevation")
    difference = (feed_of_depth.emap.layer("elevation") - by_rays).abs()
    assert difference[difference.isfinite()].median() < 2e-3


def test_rays_return_nothing_beyond_the_range_and_at_the_robot(scene, rays):
    points = rays.points(scene.data)
    reach = torch.linalg.vector_norm(points, dim=-1)
    assert reach[reach.isfinite()].max() <= 4.0 and reach.isnan().sum() > 100
    world = points @ rays.T_map_sensor(scene.data)[:3, :3].T + rays.T_map_sensor(scene.data)[:3, 3]
    x, y, z = world[reach.isfinite()].T
    assert z.max() < 0.2 + 1e-6, "neither the base nor the leg"
    assert not ((z > 0.01) & (x < 0.69)).any(), "what stands between is the leg"


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda m: MujocoRays(m, "dog", RAYS, torch.eye(4)), "body: must name a body of the model, got 'dog'"),
        (lambda m: MujocoRays(m, "base", 2 * RAYS, torch.eye(4)), "directions: must be unit vectors, got lengths"),
        (lambda m: MujocoRays(m, "base", RAYS[0], torch.eye(4)), r"directions: must be vectors \(N, 3\), got \(3,\)"),
        (lambda m: MujocoRays(m, "base", RAYS, torch.eye(4), -1.0), "max_distance: must be a positive number, got"),
        (lambda m: MujocoCamera(m, "ear", 8, 6), "camera: must name a camera of the model, got 'ear'"),
        (lambda m: MujocoCamera(m, "map", 8, 6), "camera: 'map' must be a perspective camera given by fovy"),
        (lambda m: height_field(m, "hill"), "name: must name a height field of the model, got 'hill'"),
    ],
)  # fmt: skip
def test_refuses_what_does_not_fit(scene, make, words):
    with pytest.raises(ValueError, match=words):
        make(scene.model)


# Height fields and meshes --------------------------------------------------------------------------------------------

ROWS, COLUMNS, STEP = 31, 41, 0.1  # along y and x, [m]
EYE = [0.3, -0.2, 1.5]  # [m]


@pytest.fixture(scope="module")
def heights():
    """Rough ground (COLUMNS, ROWS) [m], x along the first axis, from 0 to 0.5 m and not symmetric."""
    rough = make_terrain("rough", torch.tensor([1.0]), length=STEP * (COLUMNS - 1), resolution=STEP, seed=1).field
    ground = rough.heights[0, :COLUMNS, :ROWS].double()
    return (0.5 * (ground - ground.min()) / (ground.max() - ground.min())).numpy()


def hill(heights, source, folder):
    """A model of these heights, read from userdata, XML or PNG, or a mesh of two triangles a cell; an eye is above."""
    spec = mesh_of(heights) if source == "mesh" else field_of(heights.T / 0.5, source, folder)
    eye = spec.worldbody.add_body(name="eye", pos=EYE, mass=1.0, inertia=[1.0, 1.0, 1.0])
    eye.add_freejoint()
    return spec.compile()


def field_of(rows, source, folder):
    """A height field whose first row is given first."""
    size = [STEP * (COLUMNS - 1) / 2, STEP * (ROWS - 1) / 2, 0.5, 0.1]
    if source == "userdata":
        spec = mujoco.MjSpec()
        spec.add_hfield(name="hill", nrow=ROWS, ncol=COLUMNS, size=size, userdata=rows.flatten().tolist())
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="hill")
        return spec
    if source == "png":
        cv2 = pytest.importorskip("cv2")
        cv2.imwrite(str(folder / "hill.png"), np.round(255 * rows).astype(np.uint8))
        given = f'file="{folder / "hill.png"}"'
    else:
        values = " ".join(f"{value:.9f}" for value in rows.flatten())
        given = f'nrow="{ROWS}" ncol="{COLUMNS}" elevation="{values}"'
    hfield = f'<hfield name="hill" {given} size="{" ".join(map(str, size))}"/>'
    return mujoco.MjSpec.from_string(f"""<mujoco><asset>{hfield}</asset>
      <worldbody><geom type="hfield" hfield="hill"/></worldbody></mujoco>""")


def mesh_of(heights):
    x, y = (STEP * (np.arange(n) - (n - 1) / 2) for n in heights.shape)
    vertices = np.stack([*np.meshgrid(x, y, indexing="ij"), heights], -1).reshape(-1, 3)
    corner = (np.arange(COLUMNS - 1)[:, None] * ROWS + np.arange(ROWS - 1)).reshape(-1)
    low = np.stack([corner, corner + ROWS, corner + ROWS + 1], -1)  # both share the rising diagonal
    faces = np.concatenate([low, np.stack([corner, corner + ROWS + 1, corner + 1], -1)])
    spec = mujoco.MjSpec()
    mesh = {"uservert": vertices.flatten().tolist(), "userface": faces.flatten().tolist()}
    spec.add_mesh(name="hill", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL, **mesh)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hill")
    return spec


def reach_of(model, directions):
    """The distances [m] from the eye along unit vectors, by `MujocoRays`."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    points = MujocoRays(model, "eye", torch.from_numpy(directions), torch.eye(4), max_distance=20.0).points(data)
    return torch.linalg.vector_norm(points, dim=-1).numpy()


def is_inside(reach, directions):
    """Where rays from the eye end on the ground, a cell from its rim."""
    x, y, _ = (EYE + reach[:, None] * directions).T
    return (abs(x) < STEP * (COLUMNS - 3) / 2) & (abs(y) < STEP * (ROWS - 3) / 2)


@pytest.fixture(scope="module")
def directions():
    d = np.random.default_rng(0).normal(size=(2000, 3))
    d[:, 2] = -abs(d[:, 2]) - 0.2
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("source", ["userdata", "xml", "png"])
def test_the_height_field_of_a_model_is_what_its_rays_hit(heights, source, tmp_path, directions):
    model = hill(heights, source, tmp_path)
    field, theirs = height_field(model, "hill"), reach_of(model, directions)
    assert field.heights.shape == (1, COLUMNS, ROWS)
    tile, start, rays = (
        torch.zeros(1, dtype=torch.int64),
        torch.tensor([EYE]),
        torch.from_numpy(directions)[None].float(),
    )
    ours = cast(field, tile, start, rays, 20.0)[0].numpy()
    inside = is_inside(theirs, directions)
    assert inside.sum() > 1000 and np.quantile(abs(ours - theirs)[inside], 0.99) < 1e-4


@pytest.mark.parametrize("source, order", [("userdata", slice(None)), ("xml", slice(None, None, -1)),
                                           ("png", slice(None, None, -1))])  # fmt: skip
def test_rows_of_files_are_turned_over(heights, source, order, tmp_path):
    """The first row of an XML or a PNG is the one with the largest y; of userdata it is the one with the smallest."""
    field = height_field(hill(heights, source, tmp_path), "hill")
    assert np.abs(field.heights[0].numpy() - heights[:, order]).max() < (2e-3 if source == "png" else 1e-5)


def test_rays_on_a_mesh_of_the_same_triangles_are_those_on_the_height_field(heights, tmp_path, directions):
    mesh, field = (reach_of(hill(heights, source, tmp_path), directions) for source in ("mesh", "userdata"))
    both = is_inside(mesh, directions) & np.isfinite(field)
    assert both.sum() > 1000 and np.quantile(abs(mesh - field)[both], 0.99) < 1e-4


def test_refuses_a_height_field_whose_samples_are_not_square():
    spec = mujoco.MjSpec()
    spec.add_hfield(name="hill", nrow=3, ncol=3, size=[1, 2, 0.5, 0.1], userdata=[0.0] * 8 + [1.0])
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="hill")
    with pytest.raises(ValueError, match="name: must have samples equally far apart along x and y, got 1 and 2 m"):
        height_field(spec.compile(), "hill")
