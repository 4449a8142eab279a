"""The ceiling of ring_peg: from how many starts could the arm be at the goal within T at all?

    python -m experiments.ring_reach

Pan and lift of the shoulder have a damping of 10 N m s/rad and a torque of 1 N m, so that no constant torque turns them
faster than 0.1 rad/s: 0.5 rad within T = 500 steps of 0.01 s. The rest of the arm is much faster. There is no gravity,
and nothing else depends on the angle of pan, so that for pan, as long as the peg does not push,

    damping x (turn of pan) = (impulse of the motor) - (angular momentum about the axis of pan),

and the turn is at most 0.5 rad and a tenth of the angular momentum [N m s] that the arm still has when it passes
through the goal. For lift, motions of the other joints add a little more.

This counts the starts of rho_0 for which some collision-free configuration with the disk at the goal has both pan and
lift within a given reach of the start's. Those configurations are found by inverse kinematics in closed form: pan and
lift on a grid; the disk's centre on and beside the peg's axis, at several heights, level and tilted to four sides; the
disk's direction about its own normal, of which the wrist leaves one or two; both branches of each roll and flex.

What it says: a necessary condition. From a start without such a configuration within reach the goal is out of reach in
time, up to the grids, the momentum, and what contact with peg and table adds. What it does not say: that the others can
be solved. The arm may have to lift the ring over the peg's top on the way, and then pan and lift need longer than
straight there. So the share is an upper bound of the success on rho_0, and not a tight one.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial import cKDTree

from experiments.report import RESULTS, machine, options, write_rows
from rcg_jax.config.settings import option
from rcg_jax.tasks import make_task
from rcg_jax.tasks.ring_peg import RingPeg

#: Joints of the shoulder, which are slow.
PAN, LIFT = 0, 1

#: Where the disk may be: height of its centre above the goal point [m], offsets from the axis [m], tilts [rad].
HEIGHTS, OFFSETS, TILTS = (0.001, 0.01, 0.02, 0.028), (0.0, 0.004), (0.0, 0.06)

#: Directions of offsets and of tilts.
_SIDES = 4

#: Penetration that the solver leaves at a contact under load [m].
_DEPTH = 0.002


@dataclass(frozen=True)
class ReachOptions:
    """Settings of ``python -m experiments.ring_reach``."""

    grid: float = option(0.05, "spacing of the grid of pan and lift", unit="rad", above=0, high=0.5)
    results: str = option(str(RESULTS), "folder of the CSV file")


@dataclass(frozen=True)
class Arm:
    """The measures that inverse kinematics needs, read from the model.

    Attributes:
        base: (3,) where the axis of pan is [m].
        reach: from there to the axis of lift [m].
        upper, fore: lengths of upper arm and forearm [m].
        tool: from the wrist to the disk's centre [m].
        low, high: (7,) ranges of the joints [rad].
    """

    base: np.ndarray
    reach: float
    upper: float
    fore: float
    tool: float
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, model: mujoco.MjModel) -> Arm:
        """The arm of ring_peg's model."""

        def along(body: str) -> float:
            return float(model.body(body).pos[0])

        return cls(
            base=np.array(model.body("shoulder_pan").pos),
            reach=along("shoulder_lift"),
            upper=along("elbow_flex"),
            fore=along("wrist_flex"),
            tool=float(model.site("disk").pos[0]),
            low=model.jnt_range[:, 0].copy(),
            high=model.jnt_range[:, 1].copy(),
        )

    def _roll_flex(self, v: np.ndarray, roll: int) -> Iterator[tuple[float, float]]:
        """Angles of joints ``roll`` and ``roll + 1`` within their ranges that turn the x axis to v, a unit vector."""
        for flex in (np.arccos(np.clip(v[0], -1, 1)), -np.arccos(np.clip(v[0], -1, 1))):
            if abs(np.sin(flex)) < 1e-6 or not self.low[roll + 1] <= flex <= self.high[roll + 1]:
                continue
            first = np.arctan2(v[1] / np.sin(flex), -v[2] / np.sin(flex))
            for angle in first + 2 * np.pi * np.arange(-1, 2):
                if self.low[roll] <= angle <= self.high[roll]:
                    yield float(angle), float(flex)

    def solve(self, pan: float, lift: float, centre: np.ndarray, normal: np.ndarray) -> Iterator[np.ndarray]:
        """Configurations (7,) with these angles of the shoulder whose disk is at ``centre`` with this ``normal``.

        Args:
            pan, lift: [rad].
            centre: (3,) [m].
            normal: (3,) unit vector; the disk lies across it, either side up.
        """
        turn = _rz(pan) @ _ry(lift)
        elbow = self.base + _rz(pan)[:, 0] * self.reach + turn[:, 0] * self.upper
        first = np.cross(normal, [0.0, 1.0, 0.0] if abs(normal[1]) < 0.9 else [1.0, 0.0, 0.0])
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)

        # The wrist lies on a circle about the disk's centre, where the forearm just reaches it: |wrist - elbow| = fore
        # is x cos(angle) + y sin(angle) = z.
        away = centre - elbow
        x, y = away @ first, away @ second
        z = (away @ away + self.tool**2 - self.fore**2) / (2 * self.tool)
        if abs(z) > np.hypot(x, y):
            return
        half = np.arccos(z / np.hypot(x, y))
        for angle in (np.arctan2(y, x) + half, np.arctan2(y, x) - half):
            at = centre - self.tool * (np.cos(angle) * first + np.sin(angle) * second)
            ahead = (centre - at) / self.tool
            for roll, flex in self._roll_flex(turn.T @ (at - elbow) / self.fore, 2):
                forearm = turn @ _rx(roll) @ _ry(flex)
                for roll2, flex2 in self._roll_flex(forearm.T @ ahead, 4):
                    across = (forearm @ _rx(roll2) @ _ry(flex2)).T @ normal
                    level = np.arctan2(-across[1], across[2])  # half a turn from it the other side is up
                    for last in level + np.pi * np.arange(-2, 3):
                        if self.low[6] <= last <= self.high[6]:
                            yield np.array([pan, lift, roll, flex, roll2, flex2, last])


def _rx(a: float) -> np.ndarray:
    return np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])


def _ry(a: float) -> np.ndarray:
    return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])


def _rz(a: float) -> np.ndarray:
    return np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])


def goal_poses(task: RingPeg) -> list[tuple[np.ndarray, np.ndarray]]:
    """(centre, normal) of the disk at the goal: level on the axis first, then beside it and tilted."""
    goal = task.model.site("goal").pos
    sides = 2 * np.pi * np.arange(_SIDES) / _SIDES
    out = []
    for offset, tilt, height in itertools.product(OFFSETS, TILTS, HEIGHTS):
        for a, b in itertools.product(sides if offset else sides[:1], sides if tilt else sides[:1]):
            centre = goal + np.array([offset * np.cos(a), offset * np.sin(a), height])
            normal = np.array([np.sin(tilt) * np.cos(b), np.sin(tilt) * np.sin(b), np.cos(tilt)])
            out.append((centre, normal))
    return out


def is_goal_configuration(task: RingPeg, data: mujoco.MjData, qpos: np.ndarray) -> bool:
    """Whether C MuJoCo has the disk within the goal's radius there, and nothing in contact deeper than a load does."""
    data.qpos[:] = qpos
    mujoco.mj_forward(task.model, data)
    near = np.linalg.norm(data.site("disk").xpos - data.site("goal").xpos) < task.goal_radius
    return bool(near and (data.ncon == 0 or data.contact.dist.min() > -_DEPTH))


def goal_shoulders(task: RingPeg, pan: np.ndarray, lift: np.ndarray) -> np.ndarray:
    """Pairs (K, 2) of the grid of ``pan`` and ``lift`` [rad] that some goal configuration has."""
    arm, poses, data = Arm.of(task.model), goal_poses(task), mujoco.MjData(task.model)
    found = [
        (a, b)
        for a, b in itertools.product(pan, lift)
        if any(is_goal_configuration(task, data, q) for pose in poses for q in arm.solve(a, b, *pose))
    ]
    return np.array(found).reshape(-1, 2)


def needed_turn(starts: np.ndarray, shoulders: np.ndarray, grid: float) -> np.ndarray:
    """The least turn (N,) [rad] of pan and lift, of both at most that, to a goal configuration.

    Args:
        starts: (N, nq) positions.
        shoulders: (K, 2) from :func:`goal_shoulders`.
        grid: its spacing; half of it is taken off, for what lies between its points.
    """
    distance, _ = cKDTree(shoulders).query(starts[:, [PAN, LIFT]], p=np.inf)
    return np.maximum(distance - grid / 2, 0.0)


def own_turn(task: RingPeg) -> float:
    """What the motors alone can turn pan and lift within T [rad], the lesser of the two."""
    model = task.model
    force = model.actuator_gear[[PAN, LIFT], 0] * model.actuator_ctrlrange[[PAN, LIFT], 1]
    return float((force / model.dof_damping[[PAN, LIFT]]).min() * task.horizon * model.opt.timestep)


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    """Rows of the CSV file for a page."""
    header = "| pan and lift turn by at most | of what the motors turn in T | starts with a goal configuration there |"
    lines = [header, "|" + "---|" * 3]
    for row in rows:
        lines.append(f"| {float(row['reach_rad']):.2f} rad | {float(row['reach_of_motors']):.1f} | {row['share']} |")
    return "\n".join(lines)


def main() -> int:
    """Counts, prints and writes; returns the exit code."""
    chosen = options(ReachOptions, "experiments.ring_reach")
    task = make_task(RingPeg.name, "native")
    assert isinstance(task, RingPeg)
    low, high = task.model.jnt_range[[PAN, LIFT]].T
    pan, lift = (np.arange(a, b, chosen.grid) for a, b in zip(low, high, strict=True))
    shoulders = goal_shoulders(task, pan, lift)
    starts = np.asarray(task.feasible_starts().qpos)
    turn, own = needed_turn(starts, shoulders, chosen.grid), own_turn(task)
    about = {
        "starts_sha256": task.starts_sha256(),
        "grid_rad": chosen.grid,
        "goal_shoulders": len(shoulders),
    } | machine()
    rows = []
    for reach in (0.0, *(round(own * share, 3) for share in (0.5, 0.8, 1.0, 1.1, 1.2, 1.5, 2.0))):
        inside = int(np.sum(turn <= reach))
        cells = {"within_reach": inside, "starts": len(turn), "share": round(inside / len(turn), 4)}
        rows.append({"reach_rad": reach, "reach_of_motors": round(reach / own, 2), **cells, **about})
        print(f"turn of pan and lift <= {reach:.2f} rad: {cells['share']:.4f} of {len(turn):,} starts")
    path = Path(chosen.results) / "ring_reach.csv"
    write_rows(path, rows)
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
