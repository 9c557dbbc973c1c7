"""A control step as one compiled call, where that gives the numpy controller's bits; elsewhere the numpy controller.

Python and numpy take a third of a control step's time. What numba compiles calls the same libraries in the same order,
and the first step of a process is taken both ways: whatever differs or fails leaves the work to numpy, without a word.
"""

from __future__ import annotations

import copy
import logging

import mujoco
import numpy as np

from lerobot_memobench.sim.controller import OSCConfig, OSCController

_log = logging.getLogger(__name__)


class _Process:
    """What this process has found out: None before the first step that was taken both ways, then whether they agree."""

    agrees: bool | None = None


def make_controller(model: mujoco.MjModel) -> OSCController:
    """Return the fastest controller of a model that works here; all command the same bits."""
    if _Process.agrees is not False:
        try:
            return CompiledController(model)
        except Exception as error:  # no numba, no place for what it compiles, another BLAS, another libc: many names
            _give_up(error)
    return OSCController(model)


def _give_up(reason: object) -> None:
    _Process.agrees = False
    _log.debug("control steps are taken by numpy: %s", reason)


class CompiledController(OSCController):
    """`OSCController` with a compiled `advance`.

    Raises:
        ImportError, RuntimeError, AttributeError: numba is not installed or cannot keep what it compiles, or numpy
            has another BLAS.
    """

    def __init__(self, model: mujoco.MjModel, config: OSCConfig | None = None) -> None:
        from lerobot_memobench.sim import osc_kernel

        super().__init__(model, config)
        self._functions = osc_kernel.functions()
        self._scratch = osc_kernel.scratch(model.nv)
        low, high = self._torque_limits
        self._constants = osc_kernel.Arm(
            site=self._site,
            dof=self._dofs.start,
            qpos=self._qposs.start,
            kp=float(self._kp),
            kd=float(self._kd),
            null_kp=float(self.config.nullspace_kp),
            null_kd=float(self._null_kd),
            home=self._home,
            low=low.copy(),
            high=high.copy(),
            finger_bias=self._finger_bias,
            finger_scale=self._finger_scale,
            actuators=self._arm,
            fingers=self._fingers,
        )

    def advance(self, data: mujoco.MjData, gripper_action: float, substeps: int) -> None:
        """Do what `OSCController.advance` does."""
        # What MuJoCo cannot bear, its bindings raise; a call by address ends the process. Memory is all it may lack.
        if _Process.agrees is False or 2 * data.maxuse_arena > data.narena:
            super().advance(data, gripper_action, substeps)
        elif _Process.agrees is None:
            self._advance_both_ways(data, gripper_action, substeps)
        else:
            self._advance(data, gripper_action, substeps)

    def _advance(self, data: mujoco.MjData, gripper_action: float, substeps: int) -> None:
        from lerobot_memobench.sim import osc_kernel

        # Asked for anew each time: a copied simulation has its own memory.
        state = osc_kernel.State(
            data.qpos, data.qvel, data.site_xpos[self._site], data.site_xmat[self._site].reshape(3, 3), data.qM,
            data.qfrc_bias, data.ctrl,
        )  # fmt: skip
        gripper = self.gripper.copy()
        osc_kernel.advance(
            self._functions, self._model._address, data._address, self._constants,
            np.ascontiguousarray(self.goal_position), np.ascontiguousarray(self.goal_rotation), gripper,
            self.gripper_change(gripper_action), state, self._scratch, substeps,
        )  # fmt: skip
        self.gripper = gripper

    def _advance_both_ways(self, data: mujoco.MjData, gripper_action: float, substeps: int) -> None:
        """Advance by numpy and compiled, and decide for the process; numpy is right where they part."""
        before, numpys = self.gripper, copy.copy(data)
        super().advance(numpys, gripper_action, substeps)
        after, self.gripper = self.gripper, before
        try:
            self._advance(data, gripper_action, substeps)
            _Process.agrees = _bits(data, self.gripper) == _bits(numpys, after)
            reason: object = "what is compiled gives other numbers"
        except Exception as error:  # numba compiles at the first call
            _Process.agrees, reason = False, error
        if not _Process.agrees:
            _give_up(reason)
            mujoco.mj_copyData(data, self._model, numpys)
            self.gripper = after


def _bits(data: mujoco.MjData, gripper: np.ndarray) -> bytes:
    return b"".join(part.tobytes() for part in (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl, gripper))
