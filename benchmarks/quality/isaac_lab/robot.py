"""Write the quadruped of envs/quadruped as a USD file: the robots that Isaac Lab loads come from a server."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

ROBOT = Path(__file__).parents[3] / "envs/quadruped/robot.xml"


def write_usd(path: Path) -> Path:
    """Write the robot as an articulation with a prim per link, and return the path."""
    import mujoco
    from pxr import Usd, UsdGeom, UsdPhysics

    model = mujoco.MjModel.from_xml_path(str(ROBOT))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/quadruped").GetPrim()
    UsdPhysics.ArticulationRootAPI.Apply(root)
    stage.SetDefaultPrim(root)
    for body in range(1, model.nbody):
        _add_link(stage, model, data, body)
    for joint in range(1, model.njnt):  # the first is the free joint of the base
        _add_joint(stage, model, joint)
    stage.Save()
    return path


def _add_link(stage: Any, model: Any, data: Any, body: int) -> None:
    from pxr import Gf, UsdGeom, UsdPhysics

    link = UsdGeom.Xform.Define(stage, _link(model, body))
    _place(link, data.xpos[body] - data.xpos[1], data.xquat[body])
    UsdPhysics.RigidBodyAPI.Apply(link.GetPrim())
    mass = UsdPhysics.MassAPI.Apply(link.GetPrim())
    mass.CreateMassAttr(float(model.body_mass[body]))
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*model.body_ipos[body].tolist()))
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*model.body_inertia[body].tolist()))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(*model.body_iquat[body].tolist()))
    for geom in np.flatnonzero(model.geom_bodyid == body):
        _add_shape(stage, model, int(geom))


def _add_shape(stage: Any, model: Any, geom: int) -> None:
    import mujoco
    from pxr import Gf, UsdGeom, UsdPhysics

    path, size = f"{_link(model, int(model.geom_bodyid[geom]))}/shape_{geom}", model.geom_size[geom].tolist()
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    shape: Any
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        shape = UsdGeom.Cube.Define(stage, path)
        shape.CreateSizeAttr(2.0)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        shape = UsdGeom.Capsule.Define(stage, path)
        shape.CreateRadiusAttr(size[0])
        shape.CreateHeightAttr(2 * size[1])
        shape.CreateAxisAttr("Z")
    else:
        shape = UsdGeom.Sphere.Define(stage, path)
        shape.CreateRadiusAttr(size[0])
    _place(shape, model.geom_pos[geom], model.geom_quat[geom])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        shape.AddScaleOp().Set(Gf.Vec3f(*size))
    UsdPhysics.CollisionAPI.Apply(shape.GetPrim())


def _add_joint(stage: Any, model: Any, joint: int) -> None:
    from pxr import Gf, Sdf, UsdPhysics

    body = int(model.jnt_bodyid[joint])
    name = model.joint(joint).name
    revolute = UsdPhysics.RevoluteJoint.Define(stage, f"{_link(model, body)}/{name}_joint")
    revolute.CreateBody0Rel().SetTargets([Sdf.Path(_link(model, int(model.body_parentid[body])))])
    revolute.CreateBody1Rel().SetTargets([Sdf.Path(_link(model, body))])
    revolute.CreateLocalPos0Attr(Gf.Vec3f(*model.body_pos[body].tolist()))
    revolute.CreateLocalRot0Attr(Gf.Quatf(*model.body_quat[body].tolist()))
    revolute.CreateAxisAttr("XYZ"[int(np.argmax(model.jnt_axis[joint]))])
    lower, upper = np.rad2deg(model.jnt_range[joint]).tolist()
    revolute.CreateLowerLimitAttr(lower)
    revolute.CreateUpperLimitAttr(upper)
    UsdPhysics.DriveAPI.Apply(revolute.GetPrim(), "angular").CreateTypeAttr("force")  # its gains are the actuators'


def _link(model: Any, body: int) -> str:
    return f"/quadruped/{model.body(body).name}"


def _place(shape: Any, position: Any, quat_wxyz: Any) -> None:
    from pxr import Gf

    shape.AddTranslateOp().Set(Gf.Vec3d(*map(float, position)))
    shape.AddOrientOp().Set(Gf.Quatf(*map(float, quat_wxyz)))
