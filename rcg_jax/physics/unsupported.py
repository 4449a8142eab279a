"""What models can have that MJX and MuJoCo Warp take without a word and then leave out of their steps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np


def left_out(model: mujoco.MjModel, *, own_limits: bool) -> str:
    """The first thing of ``model`` that C MuJoCo simulates and engine=mjx would not, in words; empty if there is none.

    Args:
        own_limits: whether this package solves the joints' limits; otherwise MJX does.
    """
    kind = mujoco.mjtObj
    parts = (
        ("polynomial damping of joint", model.dof_jntid[_rows(model.dof_dampingpoly)], kind.mjOBJ_JOINT),
        ("polynomial stiffness of joint", _rows(model.jnt_stiffnesspoly), kind.mjOBJ_JOINT),
        ("polynomial damping of tendon", _rows(model.tendon_dampingpoly), kind.mjOBJ_TENDON),
        ("polynomial stiffness of tendon", _rows(model.tendon_stiffnesspoly), kind.mjOBJ_TENDON),
        ("damping of actuator", _rows(model.actuator_damping), kind.mjOBJ_ACTUATOR),
        ("polynomial damping of actuator", _rows(model.actuator_dampingpoly), kind.mjOBJ_ACTUATOR),
        ("armature of actuator", _rows(model.actuator_armature), kind.mjOBJ_ACTUATOR),
        ("history of actuator", _rows(model.actuator_history[:, 0]), kind.mjOBJ_ACTUATOR),
        ("fluid forces on the shape (fluidshape) of geom", _rows(model.geom_fluid[:, :1]), kind.mjOBJ_GEOM),
        ("equality constraint as C MuJoCo's (connect, weld)", _loops(model), kind.mjOBJ_EQUALITY),
        ("both limits at once of joint", _narrow_joints(model, own_limits), kind.mjOBJ_JOINT),
        ("both limits at once of tendon", _narrow_tendons(model), kind.mjOBJ_TENDON),
    )
    found = _first(model, parts)
    if found:
        return found
    for what, ids in (
        ("actuator", model.actuator_plugin),
        ("body", model.body_plugin),
        ("geom", model.geom_plugin),
    ):
        if (ids >= 0).any():
            which = mujoco.mj_id2name(model, getattr(kind, f"mjOBJ_{what.upper()}"), int(np.argmax(ids >= 0)))
            return f"no plugin of {what} {which or f'number {np.argmax(ids >= 0)}'}"
    if model.opt.noslip_iterations:
        return "no noslip iterations (option noslip_iterations)"
    if model.opt.disableactuator:
        return "no groups of actuators that are switched off (option actuatorgroupdisable)"
    flags = model.opt.disableflags
    if flags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        return 'no <flag filterparent="disable"/>, by which a body collides with its parent'
    for name in ("spring", "damper"):
        if flags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{name.upper()}"):
            return f'no <flag {name}="disable"/>, which would take other passive forces with it'
    return ""


#: Iterations of MuJoCo's solver and of its line search below which two engines stop at different forces.
_FEW_ITERATIONS, _FEW_SEARCHES = 6, 10


def unconverged(model: mujoco.MjModel) -> str:
    """How few solver iterations a model asks for, in words, where ``mjx.step`` then differs; empty if enough."""
    few = [
        f"{name}={value}"
        for name, value, least in (
            ("iterations", model.opt.iterations, _FEW_ITERATIONS),
            ("ls_iterations", model.opt.ls_iterations, _FEW_SEARCHES),
        )
        if value < least
    ]
    return " ".join(few)


#: Shapes whose contacts, with anything but a plane, MJX finds as those of a mesh that stands for them, or by a search
#: of its own; the forces of C MuJoCo's contacts differ from those by a tenth and more.
_APPROXIMATE = ("CYLINDER", "ELLIPSOID", "MESH", "HFIELD")


def approximate_contacts(model: mujoco.MjModel, pairs: Iterable[tuple[int, int]]) -> tuple[str, str]:
    """Contacts that ``mjx.step`` finds at other points than C MuJoCo.

    Args:
        model: the model.
        pairs: geoms that can meet.

    Returns:
        The first pair whose contacts are others altogether, and the first whose points are others (a box or a capsule
        on a plane, two boxes), so that a body tumbles differently; in words, empty if there is none.
    """
    others = ""
    for pair in pairs:
        kinds = [mujoco.mjtGeom(int(model.geom_type[g])).name.removeprefix("mjGEOM_") for g in pair]
        words = " and ".join(
            f"{kind.lower()} {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, g) or f'(geom {g})'}"
            for kind, g in zip(kinds, pair, strict=True)
        )
        curved = [kind for kind in kinds if kind in _APPROXIMATE]
        if curved and ("PLANE" not in kinds or curved[0] in ("MESH", "CYLINDER")):
            return words, others
        if not others and set(kinds) in ({"PLANE", "BOX"}, {"PLANE", "CAPSULE"}, {"BOX"}):
            others = words
    return "", others


def left_out_by_warp(model: mujoco.MjModel) -> str:
    """The first thing of ``model`` that C MuJoCo simulates and engine=warp would not, in words; empty if none."""
    return _first(
        model,
        (
            ("armature of actuator", _rows(model.actuator_armature), mujoco.mjtObj.mjOBJ_ACTUATOR),
            ("both limits at once of joint", _narrow_joints(model, False), mujoco.mjtObj.mjOBJ_JOINT),
            ("both limits at once of tendon", _narrow_tendons(model), mujoco.mjtObj.mjOBJ_TENDON),
        ),
    )


def narrow_joints(model: mujoco.MjModel) -> np.ndarray:
    """Hinges and slides, (K,), whose range is below twice its margin: there both of its ends can act at once."""
    moves = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    return np.flatnonzero(moves & (model.jnt_limited != 0) & (np.ptp(model.jnt_range, axis=1) < 2 * model.jnt_margin))


def _first(model: mujoco.MjModel, parts: Sequence[tuple[str, np.ndarray, mujoco.mjtObj]]) -> str:
    for what, where, which in parts:
        if len(where):
            return f"no {what} {mujoco.mj_id2name(model, which, where[0]) or f'number {where[0]}'}"
    return ""


def _loops(model: mujoco.MjModel) -> np.ndarray:
    """Active equality constraints that tie bodies or sites together: MJX's take another course within 40 steps."""
    ties = np.isin(model.eq_type, (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)))
    off = mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return (
        np.flatnonzero(ties & model.eq_active0.astype(bool)) if not model.opt.disableflags & off else np.zeros(0, int)
    )


def _rows(values: np.ndarray) -> np.ndarray:
    return np.flatnonzero(values.reshape(len(values), -1).any(axis=1)) if len(values) else np.zeros(0, int)


def _limits_off(model: mujoco.MjModel) -> bool:
    off = mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return bool(model.opt.disableflags & off)


def _narrow_joints(model: mujoco.MjModel, own_limits: bool) -> np.ndarray:
    return np.zeros(0, int) if own_limits or _limits_off(model) else narrow_joints(model)


def _narrow_tendons(model: mujoco.MjModel) -> np.ndarray:
    if _limits_off(model) or not model.ntendon:
        return np.zeros(0, int)
    narrow = np.ptp(model.tendon_range, axis=1) < 2 * model.tendon_margin
    return np.flatnonzero((model.tendon_limited != 0) & narrow)
