"""The ring task against the facts of the paper's original simulation, measured on the compiled model."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax.physics.engine import Engine, reset
from rcg_jax.tasks import TASKS, RingPeg, Task, make_task
from tests.engine_runs import BATCH, stepper

#: Joint: lower and upper limit [rad], damping [N m s/rad].
JOINTS = {
    "shoulder_pan": (-2.2854, 1.7146, 10),
    "shoulder_lift": (-0.5236, 1.3963, 10),
    "upper_arm_roll": (-3.9, 0.8, 0.1),
    "elbow_flex": (-2.3213, 0, 1),
    "forearm_roll": (-3.15, 3.15, 0.1),
    "wrist_flex": (-2.094, 0, 0.1),
    "wrist_roll": (-3.15, 3.15, 0.1),
}
GOAL = (0, 0.3, -0.4)
PEG = (0, 0.3)
TABLE = -0.425
SIDEWAYS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))


@pytest.fixture(scope="module")
def task(ring_peg_native: Task) -> Task:
    return ring_peg_native


@pytest.fixture
def goal_data(task: Task) -> mujoco.MjData:
    """C MuJoCo in the goal state."""
    data = mujoco.MjData(task.model)
    data.qpos[:] = task.goal_state
    mujoco.mj_forward(task.model, data)
    return data


class TestRingPegModel:
    def test_joints(self, task: Task) -> None:
        model = task.model
        assert [model.joint(i).name for i in range(model.njnt)] == list(JOINTS)
        assert model.nq == model.nv == 7
        low, high, damping = np.array(list(JOINTS.values())).T
        np.testing.assert_allclose(model.jnt_range, np.stack([low, high], 1))
        assert model.jnt_limited.all()
        np.testing.assert_allclose(model.dof_damping, damping)
        np.testing.assert_allclose(model.dof_armature, 0.04)

    def test_chain(self, task: Task) -> None:
        """Axes and offsets, read off the world frames at zero angles."""
        model, data = task.model, mujoco.MjData(task.model)
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.xanchor[0], [0, -0.188, 0])
        x = np.cumsum([0, 0.1, 0, 0.4, 0, 0.321, 0])
        np.testing.assert_allclose(data.xanchor[:, 0], x, atol=1e-12)
        z_axis, y_axis, x_axis = np.eye(3)[::-1]
        np.testing.assert_allclose(data.xaxis, [z_axis, y_axis, x_axis, y_axis, x_axis, y_axis, x_axis], atol=1e-12)
        np.testing.assert_allclose(data.site("disk").xpos - data.xanchor[6], [0.18, 0, 0], atol=1e-12)

    def test_dynamics_options(self, task: Task) -> None:
        opt = task.model.opt
        assert opt.timestep == 0.01
        assert opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
        assert not opt.gravity.any()
        assert task.horizon == 500

    def test_one_motor_of_1_newton_metre_per_joint(self, task: Task) -> None:
        data = mujoco.MjData(task.model)
        for sign in (-1, 1):
            data.ctrl[:] = 5 * sign
            mujoco.mj_forward(task.model, data)
            np.testing.assert_allclose(data.qfrc_actuator, sign)

    def test_contacts(self, task: Task) -> None:
        """The ring's four boxes meet the peg, the disk and the arm meet the table, the arm does not meet itself."""
        model = task.model
        assert (model.pair_dim == 1).all()
        np.testing.assert_allclose(model.pair_margin, 0.002)
        assert not model.geom_contype.any()
        assert not model.geom_conaffinity.any()
        names = [
            frozenset((model.geom(a).name, model.geom(b).name)) for a, b in zip(model.pair_geom1, model.pair_geom2)
        ]
        ring = {"ring_near", "ring_far", "ring_left", "ring_right"}
        assert {frozenset(("peg", r)) for r in ring} <= set(names)
        assert {frozenset(("table", r)) for r in ("ring_near", "ring_far", "forearm")} <= set(names)
        assert frozenset(("peg", "forearm")) in names
        assert all(pair & {"peg", "table"} for pair in names)

    def test_disk_is_a_square_with_a_square_hole(self, task: Task) -> None:
        """Every point of the disk's plane, from 0.1 mm inside each edge to 0.1 mm outside."""
        model = task.model
        boxes = [model.geom(f"ring_{side}") for side in ("near", "far", "left", "right")]
        centre = model.site("disk").pos
        edges = [e + d for e in (-0.15, -0.033, 0.033, 0.15) for d in (-1e-4, 1e-4)]
        for x, y in itertools.product(np.sort([*edges, *np.linspace(-0.2, 0.2, 30)]), repeat=2):
            point = centre[:2] + np.array([x, y])
            matter = any((np.abs(point - b.pos[:2]) <= b.size[:2]).all() for b in boxes)
            assert matter == (0.033 < max(abs(x), abs(y)) < 0.15), (x, y)
        for box in boxes:
            assert box.size[2] == 0.025
            assert box.pos[2] == centre[2]
            np.testing.assert_array_equal(box.quat, [1, 0, 0, 0])

    def test_peg_and_table(self, goal_data: mujoco.MjData) -> None:
        model = goal_data.model
        table, peg = goal_data.geom("table"), goal_data.geom("peg")
        assert model.geom("table").type == mujoco.mjtGeom.mjGEOM_PLANE
        assert table.xpos[2] == TABLE
        assert model.geom("peg").type == mujoco.mjtGeom.mjGEOM_CAPSULE
        radius, half = model.geom("peg").size[:2]
        assert radius == 0.028
        np.testing.assert_allclose(peg.xpos[:2], PEG)
        np.testing.assert_allclose(np.abs(peg.xmat[[2, 5, 8]]), [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(peg.xpos[2] + half + radius, TABLE + 0.15)
        assert peg.xpos[2] - half < TABLE  # no round foot above the table


class TestRingPegTask:
    def test_goal_state(self, task: Task, goal_data: mujoco.MjData) -> None:
        np.testing.assert_allclose(task.goal_state, (0.387, 1.137, -2.028, -1.744, 2.029, -0.873, 1.55))
        distance = np.linalg.norm(goal_data.site("disk").xpos - GOAL)
        assert distance == pytest.approx(0.0159, abs=5e-5)
        assert goal_data.ncon == 0  # not even within the margin
        low, high = task.model.jnt_range.T
        assert ((low < task.goal_state) & (task.goal_state < high)).all()

    def test_goal_set_and_feasible_region(self, task: Task) -> None:
        """Both are balls around the goal point, of 3 and 40 cm."""
        data = mujoco.MjData(task.model)
        rng = np.random.default_rng(0)
        spread = rng.uniform(0, 0.9, (3000, 1)) ** 2
        qpos = (task.goal_state + spread * rng.standard_normal((3000, 7))).astype(np.float32)
        s = task.snapshot(reset(jnp.asarray(qpos), jnp.zeros_like(qpos)))
        goal, feasible, got = (np.asarray(jax.vmap(f)(s)) for f in (task.is_goal, task.is_feasible, task.distance))
        distance = np.empty(3000)
        for i, q in enumerate(qpos):
            data.qpos[:] = q
            mujoco.mj_kinematics(task.model, data)
            distance[i] = np.linalg.norm(data.site("disk").xpos - GOAL)
        np.testing.assert_allclose(got, distance, atol=1e-5)
        clear = (np.abs(distance - 0.03) > 1e-4) & (np.abs(distance - 0.4) > 1e-4)
        np.testing.assert_array_equal(goal[clear], distance[clear] < 0.03)
        np.testing.assert_array_equal(feasible[clear], distance[clear] < 0.4)
        assert 10 < goal.sum() < 2900
        assert (~feasible).sum() > 10


class TestActions:
    def test_clipped_and_scaled_to_the_actuators(self, task: Task) -> None:
        """Range [-1, 3] here, so that scale and offset both show."""
        scaled = RingPeg("native")
        scaled.model.actuator_ctrlrange[:] = [-1, 3]
        recorder = _Recorder(scaled.engine)
        scaled.engine = recorder
        action = jnp.array([[-9.0, -1.0, -0.5, 0.0, 0.5, 1.0, 9.0]])
        scaled.step(scaled.reset(scaled.goal_starts()), action)
        np.testing.assert_allclose(recorder.ctrl[0], [-1, -1, 0, 1, 2, 3, 3])


class _Recorder:
    """An engine that remembers its controls and does nothing."""

    name = "recorder"

    def __init__(self, engine: Engine) -> None:
        self.model = engine.model

    def step(self, state, ctrl):
        self.ctrl = np.asarray(ctrl)
        return state


class TestRingOnPeg:
    """The peg holds the ring sideways and lets it go upwards, in both engines."""

    @pytest.fixture(params=["mjx", "native"])
    def engine(self, request: pytest.FixtureRequest) -> Engine:
        return request.getfixturevalue(f"ring_peg_{request.param}").engine

    def test_pulled_sideways_it_stays(self, task: Task, engine: Engine) -> None:
        for direction in SIDEWAYS:
            end = _move_disk(task, engine, task.goal_state, np.array(direction), steps=300)
            assert np.abs(end[:2] - PEG).max() < 0.005, direction  # the clearance
            assert end[2] < TABLE + 0.15 - 0.025, direction  # the peg reaches through the disk

    def test_lifted_it_comes_off(self, task: Task, engine: Engine) -> None:
        end = _move_disk(task, engine, task.goal_state, np.array([0, 0, 1]), steps=900)
        assert end[2] > TABLE + 0.15 + 0.025  # the whole disk is above the peg's tip


def _move_disk(task: Task, engine: Engine, qpos: np.ndarray, direction: np.ndarray, steps: int) -> np.ndarray:
    """Drives the disk along ``direction`` without turning it, as far as the motors can; returns where it ends, (3,).

    Velocity control in joint space: the joint speeds that move the disk as wanted, the torques that hold them against
    damping and inertia, scaled to the motors' limit.
    """
    model, data = task.model, mujoco.MjData(task.model)
    jacobian = np.zeros((6, 7))
    batch = BATCH if engine.name == "mjx" else 1  # the compiled batch size; all environments do the same
    state = reset(jnp.tile(jnp.asarray(qpos, jnp.float32), (batch, 1)), jnp.zeros((batch, 7)))
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    anchor, upright = data.site("disk").xpos.copy(), data.site("disk").xmat.reshape(3, 3).copy()
    for _ in range(steps):
        data.qpos[:], data.qvel[:] = np.asarray(state.qpos[0]), np.asarray(state.qvel[0])
        mujoco.mj_forward(model, data)
        disk = data.site("disk")
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("disk").id)
        drift = disk.xpos - anchor
        drift -= direction * (drift @ direction)
        twist = 0.5 * sum(np.cross(disk.xmat.reshape(3, 3)[:, k], upright[:, k]) for k in range(3))
        wanted = np.concatenate([0.15 * direction - 2 * drift, 4 * twist])
        damped = jacobian @ jacobian.T + 1e-3 * np.eye(6)
        speed = jacobian.T @ np.linalg.solve(damped, wanted)
        torque = model.dof_damping * speed + 8 * (speed - data.qvel)
        torque /= max(1.0, np.abs(torque).max())
        ctrl = jnp.tile(jnp.asarray(torque, jnp.float32), (batch, 1))
        state = stepper(engine)(state, ctrl)
    data.qpos[:] = np.asarray(state.qpos[0])
    mujoco.mj_kinematics(model, data)
    return data.site("disk").xpos.copy()


def test_unknown_names_list_the_known_ones() -> None:
    with pytest.raises(
        ValueError, match=r"task=peg_ring: must be one of point_maze, ant_maze, ring_peg, key_insertion"
    ):
        make_task("peg_ring")
    with pytest.raises(ValueError, match=r"engine=brax: must be one of mjx, native"):
        make_task("ring_peg", "brax")


@pytest.mark.parametrize("name", TASKS)
def test_only_the_ant_can_fail(name: str) -> None:
    assert make_task(name, "native").can_fail() == (name == "ant_maze")
