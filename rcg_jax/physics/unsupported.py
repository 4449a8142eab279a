"""What models can have that an engine would take without a word and then leave out of its steps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np

#: Iterations of MuJoCo's solver and of its line search below which two engines stop at different forces.
_ENOUGH = {"iterations": 6, "ls_iterations": 10}

#: Shapes whose contacts, with anything but a plane, MJX finds as those of a mesh that stands for them, or by a search
#: of its own; the forces of C MuJoCo's contacts differ from those by a tenth and more.
_APPROXIMATE = ("cylinder", "ellipsoid", "mesh", "hfield")


def name_of(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int | np.integer) -> str:
    """The name of something in a model, or its number."""
    return mujoco.mj_id2name(model, kind, index) or f"number {index}"


def shape_of(model: mujoco.MjModel, geom: int) -> str:
    """The type of a geom in words, such as ``capsule``."""
    return mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()


def geom_in_words(model: mujoco.MjModel, geom: int) -> str:
    """Type and name of a geom, such as ``box crate``."""
    return f"{shape_of(model, geom)} {mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or f'(geom {geom})'}"


def hidden_state(model: mujoco.MjModel) -> str:
    """The first thing in a model whose next step depends on more than qpos, qvel and act, in words; empty if none.

    An episode would not begin in its start: whatever the one before it left there would go on. No engine takes it.
    Mocap bodies are none: nothing moves them (:func:`rcg_jax.tasks.keyframes.place_mocap`).
    """
    for i in _rows(model.actuator_history[:, 0]):
        return f"a history (nsample, delay) of actuator {name_of(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i)}"
    if model.npluginstate:
        stateful = _rows(model.plugin_statenum)[0]
        return f"a state of plugin {name_of(model, mujoco.mjtObj.mjOBJ_PLUGIN, stateful)}"
    return ""


def left_out(model: mujoco.MjModel, *, own_limits: bool) -> str:
    """The first thing of ``model`` that C MuJoCo simulates and engine=mjx would not, in words; empty if there is none.

    With ``own_limits`` this package solves the joints' limits, otherwise MJX does.
    """
    kind = mujoco.mjtObj
    found = _first(
        model,
        (
            ("polynomial damping of joint", model.dof_jntid[_rows(model.dof_dampingpoly)], kind.mjOBJ_JOINT),
            ("polynomial stiffness of joint", _rows(model.jnt_stiffnesspoly), kind.mjOBJ_JOINT),
            ("polynomial damping of tendon", _rows(model.tendon_dampingpoly), kind.mjOBJ_TENDON),
            ("polynomial stiffness of tendon", _rows(model.tendon_stiffnesspoly), kind.mjOBJ_TENDON),
            ("damping of actuator", _rows(model.actuator_damping), kind.mjOBJ_ACTUATOR),
            ("polynomial damping of actuator", _rows(model.actuator_dampingpoly), kind.mjOBJ_ACTUATOR),
            ("armature of actuator", _rows(model.actuator_armature), kind.mjOBJ_ACTUATOR),
            ("activation that acts at once (actearly) of actuator", _early(model), kind.mjOBJ_ACTUATOR),
            ("implicitfast steps of the muscle (Euler and RK4 can) of actuator", _muscles(model), kind.mjOBJ_ACTUATOR),
            ("history of actuator", _rows(model.actuator_history[:, 0]), kind.mjOBJ_ACTUATOR),
            ("fluid forces on the shape (fluidshape) of geom", _rows(model.geom_fluid[:, :1]), kind.mjOBJ_GEOM),
            ("equality constraint as C MuJoCo's (connect, weld)", _loops(model), kind.mjOBJ_EQUALITY),
            ("both limits at once of joint", [] if own_limits else narrow_joints(model), kind.mjOBJ_JOINT),
            ("both limits at once of tendon", _narrow_tendons(model), kind.mjOBJ_TENDON),
            ("plugin of actuator", _rows(model.actuator_plugin >= 0), kind.mjOBJ_ACTUATOR),
            ("plugin of body", _rows(model.body_plugin >= 0), kind.mjOBJ_BODY),
            ("plugin of geom", _rows(model.geom_plugin >= 0), kind.mjOBJ_GEOM),
        ),
    )
    flags, disable = model.opt.disableflags, mujoco.mjtDisableBit
    passive = "which would take other passive forces with it"
    options = (
        (model.opt.noslip_iterations, "noslip iterations (option noslip_iterations)"),
        (model.opt.disableactuator, "groups of actuators that are switched off (option actuatorgroupdisable)"),
        (
            flags & disable.mjDSBL_FILTERPARENT,
            '<flag filterparent="disable"/>, by which a body collides with its parent',
        ),
        (flags & disable.mjDSBL_SPRING, f'<flag spring="disable"/>, {passive}'),
        (flags & disable.mjDSBL_DAMPER, f'<flag damper="disable"/>, {passive}'),
    )
    return found or next((f"no {what}" for used, what in options if used), "")


def left_out_by_warp(model: mujoco.MjModel) -> str:
    """The first thing of ``model`` that C MuJoCo simulates and engine=warp would not, in words; empty if none."""
    exact = model.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_FILTEREXACT)
    runge_kutta = np.flatnonzero(exact & (model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4))
    return _first(
        model,
        (
            ("RK4 steps of the activation filterexact of actuator", runge_kutta, mujoco.mjtObj.mjOBJ_ACTUATOR),
            ("armature of actuator", _rows(model.actuator_armature), mujoco.mjtObj.mjOBJ_ACTUATOR),
            ("both limits at once of joint", narrow_joints(model), mujoco.mjtObj.mjOBJ_JOINT),
            ("both limits at once of tendon", _narrow_tendons(model), mujoco.mjtObj.mjOBJ_TENDON),
        ),
    )


def unconverged(model: mujoco.MjModel) -> str:
    """How few solver iterations a model asks for, in words, where ``mjx.step`` then differs; empty if enough."""
    asked = {name: getattr(model.opt, name) for name in _ENOUGH}
    return " ".join(f"{name}={value}" for name, value in asked.items() if value < _ENOUGH[name])


def approximate_contacts(model: mujoco.MjModel, pairs: Iterable[tuple[int, int]]) -> tuple[str, str]:
    """Which of the pairs of geoms that can meet ``mjx.step`` collides otherwise than C MuJoCo.

    Returns:
        The first pair whose contacts are others altogether, and the first whose points are others (a box or a capsule
        on a plane, two boxes), so that a body tumbles differently; in words, empty if there is none.
    """
    others = ""
    for pair in pairs:
        shapes = [shape_of(model, geom) for geom in pair]
        words = " and ".join(geom_in_words(model, geom) for geom in pair)
        curved = [shape for shape in shapes if shape in _APPROXIMATE]
        if curved and ("plane" not in shapes or curved[0] in ("mesh", "cylinder")):
            return words, others
        if set(shapes) in ({"plane", "box"}, {"plane", "capsule"}, {"box"}):
            others = others or words
    return "", others


def narrow_joints(model: mujoco.MjModel) -> np.ndarray:
    """Hinges and slides, (K,), whose range is below twice its margin: there both of its ends can act at once."""
    moves = np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE))
    return _narrow(model, moves & (model.jnt_limited != 0), model.jnt_range, model.jnt_margin)


def _narrow_tendons(model: mujoco.MjModel) -> np.ndarray:
    return _narrow(model, model.tendon_limited != 0, model.tendon_range, model.tendon_margin)


def _narrow(model: mujoco.MjModel, limited: np.ndarray, ranges: np.ndarray, margins: np.ndarray) -> np.ndarray:
    off = mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return np.flatnonzero(limited & (np.ptp(ranges, axis=1) < 2 * margins) & (not model.opt.disableflags & off))


def _loops(model: mujoco.MjModel) -> np.ndarray:
    """Active equality constraints that tie bodies or sites together: MJX's take another course within 40 steps."""
    ties = np.isin(model.eq_type, (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)))
    off = mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return np.flatnonzero(ties & model.eq_active0.astype(bool) & (not model.opt.disableflags & off))


def _early(model: mujoco.MjModel) -> np.ndarray:
    """Actuators whose force is that of the activation at the end of the step."""
    return np.flatnonzero((model.actuator_dyntype != int(mujoco.mjtDyn.mjDYN_NONE)) & (model.actuator_actearly != 0))


def _muscles(model: mujoco.MjModel) -> np.ndarray:
    """Actuators whose force falls with their speed as a muscle's does, which an implicit integrator has to know."""
    implicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return np.flatnonzero((model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_MUSCLE)) & implicit)


def _rows(values: np.ndarray) -> np.ndarray:
    """Rows of an array in which something is not zero."""
    return np.unique(np.nonzero(values)[0])


def _first(model: mujoco.MjModel, parts: Sequence[tuple[str, Sequence[int] | np.ndarray, mujoco.mjtObj]]) -> str:
    found = (f"no {what} {name_of(model, kind, where[0])}" for what, where, kind in parts if len(where))
    return next(found, "")
