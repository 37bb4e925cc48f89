"""Rendering back ends: OpenGL through EGL, OpenGL through OSMesa, or ray casting without OpenGL.

A broken GL library may crash the process, so each back end is probed once, in a subprocess.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from typing import Any

BACKENDS = ("egl", "osmesa", "rays")
ENVIRONMENT = "NUREC_SIM_GL"
PROBE_TIMEOUT_S = 60

_PROBE = """
import sys, mujoco
from mujoco.{name} import GLContext
context = GLContext(64, 64)
context.make_current()
model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")
renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, renderer)
if renderer.currentBuffer != mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value:
    raise SystemExit("no offscreen buffer")
renderer.free()
context.free()
"""


@functools.cache
def why_not(name: str) -> str:
    """Why a back end does not work here; empty if it does."""
    if name == "rays":
        return ""
    # MuJoCo and PyOpenGL choose their library by these variables; the probe must test the named one.
    environment = {key: value for key, value in os.environ.items() if key not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE.format(name=name)],
            capture_output=True, text=True, timeout=PROBE_TIMEOUT_S, env=environment, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"no answer within {PROBE_TIMEOUT_S} seconds"
    if done.returncode == 0:
        return ""
    lines = done.stderr.strip().splitlines()
    return lines[-1] if lines else f"the trial ended with status {done.returncode}"


def pick_backend(wanted: str | None = None) -> str:
    """The back end to use: ``wanted``, else that of NUREC_SIM_GL, else the first of egl, osmesa, rays that works.

    Raises:
        ValueError: no back end has that name.
        RuntimeError: the requested one does not work here.
    """
    wanted = wanted or os.environ.get(ENVIRONMENT) or None
    if wanted is None:
        return next(name for name in BACKENDS if not why_not(name))
    if wanted not in BACKENDS:
        raise ValueError(f"no rendering back end {wanted!r}; have {', '.join(BACKENDS)} ({ENVIRONMENT} sets it)")
    if reason := why_not(wanted):
        raise RuntimeError(f"the rendering back end {wanted!r} does not work here: {reason}; 'rays' always does")
    return wanted


def gl_context(name: str) -> Any:
    """An OpenGL context of back end ``egl`` or ``osmesa``, not yet current in any thread. The caller frees it.

    Raises:
        RuntimeError: this process already uses the other one; PyOpenGL binds to a single library.
    """
    other = {"egl": "osmesa", "osmesa": "egl"}[name]
    if f"mujoco.{other}" in sys.modules:
        raise RuntimeError(f"this process already renders with {other!r} and cannot use {name!r} as well")
    # PyOpenGL reads this on its first import, so the import below must come after it.
    os.environ["PYOPENGL_PLATFORM"] = name
    if name == "egl":
        from mujoco.egl import GLContext
    else:
        from mujoco.osmesa import GLContext
    return GLContext(64, 64)
