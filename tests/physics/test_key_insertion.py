"""The key task: its geometry against the original simulation's, the lock as a lock, its starts, and both engines."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rcg_jax.io.starts_file import load_states
from rcg_jax.physics.engine import reset
from rcg_jax.tasks import Task, make_task
from rcg_jax.tasks.key_insertion import KeyInsertion
from tests.engine_runs import trajectory
from tests.key_motions import (
    INSERTED,
    LOCKED,
    OUTSIDE,
    PUSHED,
    QUARTER,
    TURNED,
    Motion,
    Outcome,
    joint_path,
    run_motions,
)

TARGETS = np.array([[0, 0.3, -0.7], [0, 0.3, -0.4], [-0.15, 0.3, -0.55]])
POINTS = ("tip", "top", "side")
HOLE = (0, 0.3, -0.55)
KEY = {"shaft", "tooth_left", "tooth_right"}
#: The slabs of the original lock that the key can meet: centre and half size.
SLABS = (
    ((0.216, 0.3, -0.55), (0.183, 0.469, 0.025)),
    ((-0.216, 0.3, -0.55), (0.183, 0.469, 0.025)),
    ((0, 0.586, -0.55), (0.032, 0.183, 0.025)),
    ((0, 0.084, -0.55), (0.032, 0.19, 0.025)),
    ((-0.216, 0.3, -0.62), (0.183, 0.469, 0.025)),
    ((0, 0.586, -0.62), (0.032, 0.183, 0.025)),
    ((0, 0.084, -0.62), (0.032, 0.19, 0.025)),
    ((0, 0.38, -0.648), (0.183, 0.025, 0.002)),
    ((-0.216, 0.3, -0.6715), (0.183, 0.469, 0.0205)),
    ((0, 0.38, -0.695), (0.183, 0.15, 0.002)),  # the floor
)


@pytest.fixture(scope="module")
def task() -> Task:
    return make_task("key_insertion", "native")


@pytest.fixture(scope="module")
def shipped() -> np.ndarray:
    return load_states(KeyInsertion.feasible_file)[0]


def capsule_ends(model: mujoco.MjModel, name: str) -> tuple[np.ndarray, float]:
    """Both ends (2, 3) of a capsule's axis in the axes of its body, and its radius [m]."""
    geom = model.geom(name)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, geom.quat)
    half = turn.reshape(3, 3)[:, 2] * geom.size[1]
    return np.stack([geom.pos - half, geom.pos + half]), float(geom.size[0])


class TestModel:
    def test_the_arm_is_that_of_ring_peg(self, task: Task, ring_peg_native: Task) -> None:
        mine, ring = task.model, ring_peg_native.model
        for name in ("jnt_range", "jnt_axis", "jnt_pos", "dof_damping", "dof_armature", "actuator_gear"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(ring, name), err_msg=name)
        for name in ("body_pos", "body_quat", "body_mass", "body_inertia", "body_ipos"):
            np.testing.assert_array_equal(getattr(mine, name)[:-1], getattr(ring, name)[:-1], err_msg=name)
        np.testing.assert_array_equal(mine.body_pos[-1], ring.body_pos[-1])
        np.testing.assert_array_equal(mine.actuator_ctrlrange, ring.actuator_ctrlrange)
        assert [mine.joint(i).name for i in range(7)] == [ring.joint(i).name for i in range(7)]
        for name in ("timestep", "integrator", "solver", "gravity", "disableflags"):
            np.testing.assert_array_equal(getattr(mine.opt, name), getattr(ring.opt, name))
        assert task.horizon == 500

    def test_key(self, task: Task) -> None:
        """Extents in the tool frame: a shaft of radius 28 mm from z = 0.05 to -0.25; teeth as wide, 25 mm high."""
        model = task.model
        tool = np.array([0.18, 0, 0])
        ends, radius = capsule_ends(model, "shaft")
        assert radius == 0.028
        np.testing.assert_allclose((ends - tool)[:, :2], 0, atol=1e-12)
        np.testing.assert_allclose(np.add(np.sort(ends[:, 2]), (-radius, radius)), [-0.25, 0.05])
        teeth = [capsule_ends(model, name) for name in ("tooth_left", "tooth_right")]
        low = np.min([ends.min(0) - r for ends, r in teeth], 0) - tool
        high = np.max([ends.max(0) + r for ends, r in teeth], 0) - tool
        np.testing.assert_allclose(low, [-0.028, -0.084, -0.25], atol=1e-9)
        np.testing.assert_allclose([high[0], high[2]], [0.028, -0.225], atol=1e-9)
        assert high[1] <= radius
        for name, pos in zip(POINTS, ((0, 0, -0.25), (0, 0, 0.05), (0.15, 0, -0.1))):
            np.testing.assert_allclose(model.site(name).pos - tool, pos, atol=1e-12)

    def test_lock(self, task: Task) -> None:
        """Solid where the original's is; otherwise free but in gaps between its layers, too low for the teeth."""
        model = task.model
        boxes = [model.geom(f"lock_{side}") for side in ("left", "right", "far", "near", "bar")]
        floor = model.geom("lock_floor").pos[2]
        assert all(b.type == mujoco.mjtGeom.mjGEOM_BOX for b in boxes)
        points = np.random.default_rng(0).uniform([-0.12, 0.15, -0.7], [0.1, 0.5, -0.5], (200_000, 3))

        def within(slabs) -> np.ndarray:
            return np.any([(np.abs(points - np.array(p)) <= s).all(1) for p, s in slabs], axis=0)

        ours = within((b.pos, b.size) for b in boxes) | (points[:, 2] < floor)
        original = within(SLABS)
        assert ours[original].all()
        x, y, z = points.T
        gap = ((z > -0.595) & (z < -0.575)) | ((z > -0.651) & (z < -0.645)) | ((z > -0.693) & (z < -0.692))
        extra = ours & ~original
        assert (gap | (z < floor))[extra].all()
        assert not (extra & (np.abs(x) < 0.032) & (y > 0.275) & (y < 0.402) & (z > floor)).any()  # not in the slot
        # The original's lower right slab is not a box of ours: nothing reaches it.
        teeth = [capsule_ends(model, name) for name in ("tooth_left", "tooth_right")]
        reach = max(np.linalg.norm(ends[:, :2] - [0.18, 0], axis=1).max() + r for ends, r in teeth)
        assert reach + 0.005 + 0.02 < 0.113

    def test_contacts(self, task: Task) -> None:
        """Key against all of the lock, arm against its face, and nothing else."""
        model = task.model
        assert (model.pair_dim == 1).all()
        np.testing.assert_allclose(model.pair_margin, 0.002)
        assert not model.geom_contype.any()
        assert not model.geom_conaffinity.any()
        pairs = {(model.geom(a).name, model.geom(b).name) for a, b in zip(model.pair_geom1, model.pair_geom2)}
        pairs = {tuple(sorted(p, key=lambda name: not name.startswith("lock"))) for p in pairs}
        lock = {f"lock_{part}" for part in ("left", "right", "far", "near", "bar", "floor")}
        arm = {"upper_arm", "forearm", "palm"}
        assert pairs == {(a, b) for a in lock for b in KEY} | {("lock_face", b) for b in arm}
        assert model.npair == len(pairs)


def evaluate(task: Task, qpos: np.ndarray, *functions) -> list[np.ndarray]:
    """Functions of one snapshot, in the states (C, nq) at rest."""

    @jax.jit
    def values(qpos: jax.Array) -> list[jax.Array]:
        s = task.snapshot(reset(qpos, jnp.zeros_like(qpos)))
        return [jax.vmap(f)(s) for f in functions]

    return jax.device_get(values(jnp.asarray(qpos, jnp.float32)))


def tips(task: Task, qpos: np.ndarray) -> np.ndarray:
    """Positions of the key's tip (C, 3) [m]."""
    site = task.model.site("tip").id
    return evaluate(task, qpos, lambda s: s.site_xpos[site])[0]


class TestTask:
    def test_goal_state(self, task: Task) -> None:
        data = mujoco.MjData(task.model)
        data.qpos[:] = task.goal_state
        mujoco.mj_forward(task.model, data)
        difference = np.stack([data.site(name).xpos for name in POINTS]) - TARGETS
        # The floor and the near end of the slot, with the margin of both, leave no less than 0.017.
        assert np.linalg.norm(difference) == pytest.approx(0.0182, abs=1e-4)
        assert data.ncon == 0  # not even within the margin
        low, high = task.model.jnt_range.T
        assert ((low + 0.01 < task.goal_state) & (task.goal_state < high - 0.01)).all()
        original = np.array([1.55, 0.4, -3.75, -1.15, 1.81, -2.09, 0.05])
        assert np.abs(task.goal_state - original).max() < 0.05

    def test_goal_state_stays_a_goal_for_an_episode(self, task: Task) -> None:
        q, _ = trajectory(task.engine, task.goal_state.astype(np.float32)[None], np.zeros((500, 1, 7), np.float32))
        assert evaluate(task, q[:, 0], task.distance)[0].max() < 0.019

    def test_goal_set_and_feasible_region(self, task: Task) -> None:
        data = mujoco.MjData(task.model)
        rng = np.random.default_rng(0)
        spread = rng.uniform(0, 0.9, (3000, 1)) ** 3
        qpos = (task.goal_state + spread * rng.standard_normal((3000, 7))).astype(np.float32)
        goal, feasible, got = evaluate(task, qpos, task.is_goal, task.is_feasible, task.distance)
        norm, tip = np.empty(3000), np.empty(3000)
        for i, q in enumerate(qpos):
            data.qpos[:] = q
            mujoco.mj_kinematics(task.model, data)
            norm[i] = np.linalg.norm([data.site(name).xpos - t for name, t in zip(POINTS, TARGETS)])
            tip[i] = np.linalg.norm(data.site("tip").xpos - HOLE)
        np.testing.assert_allclose(got, norm, atol=1e-5)
        clear = (np.abs(norm - 0.03) > 1e-4) & (np.abs(tip - 0.4) > 1e-4)
        np.testing.assert_array_equal(goal[clear], norm[clear] < 0.03)
        np.testing.assert_array_equal(feasible[clear], tip[clear] < 0.4)
        assert 10 < goal.sum() < 2900
        assert (~feasible).sum() > 10


@pytest.fixture(scope="module")
def outside(task: Task) -> np.ndarray:
    """Joint angles with the key above the lock, as the way out of the goal state ends."""
    return joint_path(task, task.goal_state, [LOCKED, PUSHED, TURNED, INSERTED, OUTSIDE])


def scripted(task: Task, outside: np.ndarray) -> dict[str, Motion]:
    """What is tried with the key, by name."""

    def via(*poses: tuple[float, float]) -> Motion:
        return Motion(joint_path(task, outside[-1], [OUTSIDE, *poses]))

    goal, pushed = task.goal_state[None], joint_path(task, task.goal_state, [LOCKED, PUSHED])[-1:]
    return {
        "four stages": Motion(outside[::-1]),
        "four stages back": Motion(outside),
        "without insertion": via((OUTSIDE[0], QUARTER), PUSHED, LOCKED),
        "without turning": via(INSERTED, LOCKED),
        "turned the wrong way": via(INSERTED, (INSERTED[0], -0.5), (LOCKED[0], -0.5), LOCKED),
        "without pushing": via(INSERTED, TURNED, INSERTED, LOCKED),
        "straight out": Motion(joint_path(task, task.goal_state, [LOCKED, OUTSIDE])),
        "pulled with 20 N": Motion(goal, (0, 0, 20)),
        "pulled with 30 N": Motion(goal, (0, 0, 30)),
        "pulled before turning back": Motion(pushed, (0, 0, 20)),
    }


@pytest.fixture(scope="module")
def motions(task: Task, outside: np.ndarray) -> dict[str, Motion]:
    return scripted(task, outside)


@pytest.fixture(scope="module", params=["native", pytest.param("mjx", marks=pytest.mark.slow)])
def outcomes(request: pytest.FixtureRequest, task: Task, motions: dict[str, Motion]) -> dict[str, Outcome]:
    return run_motions(task, request.param, motions)


@pytest.fixture(scope="module")
def without_lock(task: Task, motions: dict[str, Motion]) -> dict[str, Outcome]:
    """The control: the same motions where nothing collides."""
    return run_motions(task, "native", motions, contacts=False)


def holds(outcome: Outcome, steps: int) -> bool:
    """Whether a pulled key tilts until its teeth catch the bar, and then stays."""
    rise = outcome.tip[:steps, 2] - LOCKED[0]
    return bool(0.01 < rise.max() < 0.04 and np.ptp(rise[400:]) < 0.002)


#: Ways to the goal that leave out a stage: the least distance to it that the lock leaves, where the tip has to end [m].
SKIPPED = {
    "without insertion": (0.3, (-0.54, np.inf)),  # the face stops a key that was turned before
    "without turning": (0.09, (-0.65, -0.63)),  # the bar stops these
    "turned the wrong way": (0.09, (-0.65, -0.63)),
    "without pushing": (0.09, (-0.65, -0.63)),
}


class TestLock:
    @pytest.mark.slow
    def test_four_stages_lead_to_the_goal_and_out_of_it(self, outcomes) -> None:
        there, back = outcomes["four stages"], outcomes["four stages back"]
        assert there.distance[0] > 0.4
        assert there.distance[-1] < 0.02
        assert back.distance[0] < 0.02
        assert back.tip[-1, 2] == pytest.approx(OUTSIDE[0], abs=0.005)

    @pytest.mark.parametrize("skipped", SKIPPED)
    def test_each_stage_on_the_way_is_needed(self, outcomes, without_lock, skipped: str) -> None:
        least, (low, high) = SKIPPED[skipped]
        assert outcomes[skipped].distance.min() > least
        assert low < outcomes[skipped].tip[-1, 2] < high
        assert without_lock[skipped].distance.min() < KeyInsertion.goal_radius
        assert without_lock[skipped].tip[:, 2].min() < -0.68

    def test_turning_back_locks(self, outcomes, without_lock) -> None:
        """The same pull takes a key past the bar that was not turned back, and does not take one that was."""
        before, after = (outcomes[f"pulled {name}"] for name in ("before turning back", "with 20 N"))
        assert before.tip[-1, 2] > -0.61
        assert before.distance.min() >= KeyInsertion.goal_radius
        assert after.tip[:, 2].max() < -0.65
        assert without_lock["pulled with 20 N"].tip[:, 2].max() > 0

    def test_the_motors_cannot_pull_it_straight_out(self, outcomes, without_lock) -> None:
        assert outcomes["straight out"].tip[:, 2].max() < -0.65
        assert without_lock["straight out"].tip[-1, 2] == pytest.approx(OUTSIDE[0], abs=0.005)

    @pytest.mark.parametrize(("force", "steps"), [(20, 3000), (30, 1000)])
    def test_pulled_upwards_it_holds(self, outcomes, without_lock, force: int, steps: int) -> None:
        """By 30 N [N, number of steps] the key, without friction, is turned out within 30 s."""
        assert holds(outcomes[f"pulled with {force} N"], steps)
        assert not holds(without_lock[f"pulled with {force} N"], steps)

    def test_without_the_bar_the_same_pull_takes_it_out(self) -> None:
        class Open(KeyInsertion):
            def make_model(self) -> mujoco.MjModel:
                spec = mujoco.MjSpec.from_file(str(self.xml))
                for pair in [p for p in spec.pairs if "lock_bar" in (p.geomname1, p.geomname2)]:
                    spec.delete(pair)
                return spec.compile()

        task = Open("native")
        out = run_motions(task, "native", {"pulled": Motion(task.goal_state[None], (0, 0, 20))})["pulled"]
        assert out.tip[:1000, 2].max() > -0.5


class TestFeasibleStarts:
    def test_lie_above_the_lock_or_in_it(self, task: Task, shipped: np.ndarray) -> None:
        """No tip is below the face beside the slot, where only a key that passed through the slabs could be."""
        tip = tips(task, shipped)
        assert np.linalg.norm(tip - HOLE, axis=1).max() < 0.4
        x, y, z = tip[tip[:, 2] < -0.55].T
        assert np.abs(x).max() < 0.06
        assert y.min() > 0.24
        assert y.max() < 0.42
        assert z.min() > -0.693
