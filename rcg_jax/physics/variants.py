"""Models that differ a little from a task's own: for domain randomisation, and for evaluation in a changed world."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping

import mujoco
import numpy as np

from rcg_jax.physics.engine import UnsupportedModelError


def _scale_friction(model: mujoco.MjModel, factor: float) -> None:
    model.geom_friction *= factor
    model.pair_friction *= factor


def _scale_mass(model: mujoco.MjModel, factor: float) -> None:
    model.body_mass *= factor
    model.body_inertia *= factor
    strength = model.actuator_acc0.copy()  # from which muscles have their force
    mujoco.mj_setConst(model, mujoco.MjData(model))  # what follows from masses
    model.actuator_acc0[:] = strength


def _scale_damping(model: mujoco.MjModel, factor: float) -> None:
    model.dof_damping *= factor
    model.dof_dampingpoly *= factor
    model.actuator_damping *= factor
    model.actuator_dampingpoly *= factor


def _scale_motors(model: mujoco.MjModel, factor: float) -> None:
    """The force of motors and servos, whose gains and biases it is linear in."""
    gains, biases = mujoco.mjtGain, mujoco.mjtBias
    linear = np.isin(model.actuator_gaintype, [int(gains.mjGAIN_FIXED), int(gains.mjGAIN_AFFINE)])
    linear &= np.isin(model.actuator_biastype, [int(biases.mjBIAS_NONE), int(biases.mjBIAS_AFFINE)])
    linear &= model.actuator_plugin < 0
    if not linear.all():
        raise UnsupportedModelError("motor: the model has an actuator that is neither a motor nor a servo")
    model.actuator_gainprm *= factor
    model.actuator_biasprm *= factor
    model.actuator_forcerange *= factor
    model.jnt_actfrcrange *= factor
    model.tendon_actfrcrange *= factor


def _has_friction(model: mujoco.MjModel) -> bool:
    """Whether any contact of the model has more than its normal force."""
    condims = np.concatenate([model.geom_condim[(model.geom_contype | model.geom_conaffinity) > 0], model.pair_dim])
    return bool((condims > 1).any())


def _has_damping(model: mujoco.MjModel) -> bool:
    fields = (model.dof_damping, model.dof_dampingpoly, model.actuator_damping, model.actuator_dampingpoly)
    return any(bool(np.any(field)) for field in fields)


#: Of what can be scaled, what a model may lack.
_HAS: Mapping[str, Callable[[mujoco.MjModel], bool]] = {"friction": _has_friction, "damping": _has_damping}

#: What can be scaled in a model: friction of all contacts, masses and inertias of all bodies, damping of all joints,
#: force of all actuators.
SCALES: Mapping[str, Callable[[mujoco.MjModel, float], None]] = {
    "friction": _scale_friction,
    "mass": _scale_mass,
    "damping": _scale_damping,
    "motor": _scale_motors,
}


def scaled(model: mujoco.MjModel, factors: Mapping[str, float]) -> mujoco.MjModel:
    """A copy of ``model`` in which each of :data:`SCALES` named in ``factors`` is so many times as large.

    Raises:
        UnsupportedModelError: motors are to be scaled, and the model has muscles or the like; or friction or damping,
            and it has none.
    """
    changed = copy.copy(model)
    for name, factor in factors.items():
        if name in _HAS and not _HAS[name](model):
            raise UnsupportedModelError(f"{name}: the model has none")
        SCALES[name](changed, factor)
    return changed


def random_variants(model: mujoco.MjModel, spread: Mapping[str, float], num: int, seed: int) -> list[mujoco.MjModel]:
    """``num`` copies of ``model``, each with factors of its own, drawn log-uniformly from [1 / (1 + x), 1 + x].

    Args:
        model: the model.
        spread: x for each of :data:`SCALES` that varies, >= 0.
        num: how many.
        seed: of the draws.

    Raises:
        UnsupportedModelError: as :func:`scaled`.
    """
    rng = np.random.default_rng(seed)
    names = [name for name, x in spread.items() if x]
    exponents = rng.uniform(-1.0, 1.0, (num, len(names)))
    return [
        scaled(model, {name: (1 + spread[name]) ** e for name, e in zip(names, row, strict=True)}) for row in exponents
    ]
