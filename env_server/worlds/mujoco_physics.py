"""MuJoCo models whose mass, friction and gravity drift."""

from __future__ import annotations

import mujoco
import numpy as np

from env_server.worlds.physics import Factors, Physics

_NUDGE = 0.1  # rad or m off the reference pose, where a joint may stand exactly upright


class ModelPhysics:
    """Keeps a model's physics at the factors of the unit.

    Armature, joint damping and motors stay as they are: a heavier body has the same joints.
    """

    def __init__(self, model: mujoco.MjModel, physics: Physics) -> None:
        """`model` as it was built: its values are what the factors multiply."""
        self._model = model
        self._physics = physics
        self._applied = Factors(1.0, 1.0, 1.0)
        self._mass, self._inertia = model.body_mass.copy(), model.body_inertia.copy()
        self._sliding, self._pair_sliding = (
            model.geom_friction[:, 0].copy(),
            model.pair_friction[:, :2].copy(),
        )
        self._gravity = model.opt.gravity.copy()
        self._scratch = mujoco.MjData(model)  # mj_setConst works in it, and the state is not touched

    def apply(self, t: int) -> None:
        """Set the physics of unit t; costs something only when a factor changed. The state stays."""
        factors = self._physics.factors(t)
        if factors == self._applied:
            return
        model = self._model
        if factors.mass != self._applied.mass:
            # Together, or the fluid's boxes, which MuJoCo derives from their ratio, would change size.
            model.body_mass[:] = factors.mass * self._mass
            model.body_inertia[:] = factors.mass * self._inertia
            mujoco.mj_setConst(model, self._scratch)  # subtree masses and inverse weights of contacts
        model.geom_friction[:, 0] = factors.friction * self._sliding
        model.pair_friction[:, :2] = factors.friction * self._pair_sliding
        model.opt.gravity[:] = factors.gravity * self._gravity
        self._applied = factors


def tunable(model: mujoco.MjModel) -> tuple[str, ...]:
    """Which factors mean something in a model: friction where geoms rub, gravity where it moves a joint."""
    found = ["mass"]
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    if model.npair or bool((collides & (model.geom_condim >= 3)).any()):
        found.append("friction")
    data = mujoco.MjData(model)
    data.qpos[:] += _NUDGE
    mujoco.mj_forward(model, data)
    if bool(np.abs(data.qfrc_bias).max(initial=0.0) > 0):  # at rest it is gravity's force alone
        found.append("gravity")
    return tuple(found)
