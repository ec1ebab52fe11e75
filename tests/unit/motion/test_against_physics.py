"""The core's own kinematics and dynamics beside those of the physics engine, for every arm."""

from __future__ import annotations

import numpy as np
import pytest

from controller.config.arm import load_arm
from controller.domain import ArmDescription, Array
from controller.motion import dynamics, kinematics
from tests.unit.motion.scene import ARMS

mujoco = pytest.importorskip("mujoco")


def mjcf(arm: ArmDescription) -> str:
    """The arm as bodies with point masses (a point mass needs some inertia: 1e-9 kg m^2)."""
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    text, closing = "", ""
    for joint, link in zip(arm.joints, arm.links, strict=True):
        offset = " ".join(str(v * 1e-3) for v in joint.offset)
        center = np.array(link.center) * 1e-3
        if joint.name == arm.joints[0].name:
            center[2] = 0.0
        text += (
            f'<body name="{joint.name}" pos="{offset}"><joint name="{joint.name}" axis="{axes[joint.axis]}"/>'
            f'<inertial pos="{center[0]} {center[1]} {center[2]}" mass="{link.mass}" diaginertia="1e-9 1e-9 1e-9"/>'
        )
        closing += "</body>"
    tool = " ".join(str(v * 1e-3) for v in arm.tool)
    text += f'<site name="tool" pos="{tool}"/>' + closing
    return (
        '<mujoco><compiler angle="radian"/><option gravity="0 0 -9.80665"><flag contact="disable"/></option>'
        f"<worldbody>{text}</worldbody></mujoco>"
    )


def postures(arm: ArmDescription, count: int) -> Array:
    c = kinematics.chain(arm)
    return np.random.default_rng(7).uniform(c.low, c.high, (count, c.joints))


@pytest.mark.parametrize("name", ARMS)
def test_forward_kinematics_agree(name: str) -> None:
    arm = load_arm(name)
    model = mujoco.MjModel.from_xml_string(mjcf(arm))
    data = mujoco.MjData(model)
    for q, tool in zip(postures(arm, 100), kinematics.forward(arm, postures(arm, 100)), strict=True):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        # 0.01 mm is the requirement; the two agree to rounding.
        assert np.abs(data.site_xpos[0] * 1e3 - tool[:3, 3]).max() < 1e-6
        assert np.abs(data.site_xmat[0].reshape(3, 3) - tool[:3, :3]).max() < 1e-9


@pytest.mark.parametrize("name", ARMS)
def test_joint_torques_agree(name: str) -> None:
    arm = load_arm(name)
    model = mujoco.MjModel.from_xml_string(mjcf(arm))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(8)
    q = postures(arm, 100)
    qd, qdd = rng.uniform(-2.5, 2.5, q.shape), rng.uniform(-12.0, 12.0, q.shape)
    if q.shape[1] == 5:
        # What the roll carries counts as lying on its axis, so the roll is left still and upright here.
        q[:, 4] = qd[:, 4] = qdd[:, 4] = 0.0
    own = dynamics.torque(arm, q, qd, qdd)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(model, data)
        # The core keeps every centre of mass in the arm's plane; the true ones lie up to 0.5 mm beside it: some
        # 5 mNm at these accelerations, a hundredth of a degree of sag.
        assert np.abs(data.qfrc_inverse - own[k])[:4].max() < 8e-3


def test_a_streamed_move_arrives_where_it_should() -> None:
    """A spring-like servo told the goals follows the positions; told the positions alone it sags."""
    from controller.motion.path import join, line, stroke
    from controller.motion.trajectory import generate

    arm = load_arm("reactorx_150")
    top = kinematics.inverse(arm, (210.0, 60.0, 80.0), roll=0.5)[0]
    down = stroke(arm, top, -60.0)
    path = join(arm, [line(arm, np.array(arm.ready), top), down], [(100.0, 30.0)])
    move = generate(arm, path, "approach")
    with_offset, without = (_follow(arm, move.positions, goals) for goals in (move.goals, move.positions))
    wanted = kinematics.points(arm, move.positions)[:, 3]
    # Friction is compensated to 0.6 and the samples are 10 ms apart; the study saw 0.7 mm median.
    assert np.linalg.norm(kinematics.points(arm, with_offset)[:, 3] - wanted, axis=1).max() < 2.0
    assert np.linalg.norm(kinematics.points(arm, without)[:, 3] - wanted, axis=1).max() > 10.0


def _follow(arm: ArmDescription, positions: Array, goals: Array) -> Array:
    """Where joints with the described stiffness, damping, friction and rotors are at the end of every period."""
    model = mujoco.MjModel.from_xml_string(mjcf(arm))
    model.opt.timestep = 0.0005
    servo = [joint.dynamics for joint in arm.joints]
    model.dof_damping[:] = [s.damping for s in servo]
    model.dof_armature[:] = [s.inertia for s in servo]
    model.dof_frictionloss[:] = [s.friction for s in servo]
    stiffness = np.array([s.stiffness for s in servo])
    data = mujoco.MjData(model)
    data.qpos[:] = positions[0]
    out = [np.array(data.qpos)]
    for goal in goals[:-1]:
        for _ in range(20):
            data.qfrc_applied[:] = stiffness * (goal - data.qpos)
            mujoco.mj_step(model, data)
        out.append(np.array(data.qpos))
    return np.array(out)
