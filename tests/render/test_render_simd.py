"""The renderer for other processors than this one: every instruction set against the float64 reference.

Each set needs a process of its own, for which this file is also a program.
"""

import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from render_scenes import START_US, camera, cloud, moved, psnr_db, request, scene

from nurec_sim.render.cpu.kernel import fixed, inner
from nurec_sim.render.cpu.simd import vector_kernel

X86 = platform.machine() in ("x86_64", "AMD64")
MACHINES = {
    "AVX2, chosen": ({"NUREC_SIM_SIMD": "avx2"}, "avx2", 8),
    "plain, chosen": ({"NUREC_SIM_SIMD": "plain"}, "plain", 8),
    "Haswell": ({"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": ""}, "avx2", 8),
    "any x86-64": ({"NUMBA_CPU_NAME": "x86-64", "NUMBA_CPU_FEATURES": ""}, "plain", 8),
}
HELPERS = Path(__file__).parents[1] / "helpers"
COMPILED = ("Haswell", "any x86-64")
"""Those whose kernels are compiled and run here; a choice on this machine is the same code for other registers."""


def run(program, **environment):
    """Standard output of Python in a fresh process; its last line of errors where it fails."""
    environment |= {"PYTHONPATH": str(HELPERS)}
    own = {name: value for name, value in os.environ.items() if not name.startswith(("NUREC_SIM_SIMD", "NUMBA_CPU"))}
    done = subprocess.run(
        [sys.executable, *program], env=own | environment, cwd=HELPERS, capture_output=True, text=True
    )
    return done.stdout if done.returncode == 0 else done.stderr.strip().splitlines()[-1]


def instruction_set(**environment):
    return run(["-c", "from nurec_sim.render.cpu import simd; print(simd.INSTRUCTION_SET, simd.LANES)"], **environment)


@pytest.mark.skipif(not X86, reason="names of x86 processors")
@pytest.mark.parametrize("machine", list(MACHINES))
def test_the_instruction_set_follows_the_processor_and_the_user(machine):
    environment, expected, lanes = MACHINES[machine]
    assert instruction_set(**environment).split() == [expected, str(lanes)]


def test_an_unknown_instruction_set_is_refused():
    text = instruction_set(NUREC_SIM_SIMD="sse9")
    assert text == "ValueError: NUREC_SIM_SIMD must be one of avx512, avx2, plain, got 'sse9'"


@pytest.mark.slow
@pytest.mark.skipif(not X86, reason="names of x86 processors")
@pytest.mark.parametrize("machine", COMPILED)
def test_every_instruction_set_draws_what_the_reference_draws(machine):
    environment, expected, _ = MACHINES[machine]
    result = json.loads(run([__file__], **environment))
    assert result["instruction_set"] == expected
    assert min(result["psnr_db"].values()) >= 60, result
    assert result["median_range_error_m"] < 1e-3 and result["beams"] > 80


def draw_and_compare():
    """Kernels of cameras and LiDARs, still and moving, against the reference, as JSON on standard output."""
    from nurec_sim import sensors
    from nurec_sim.render import CpuRenderer, spec
    from nurec_sim.render.cpu import simd
    from nurec_sim.types import Fisheye, Shutter

    began = time.perf_counter()
    world = scene(cloud(300, sh=3), sky=np.random.default_rng(1).random((6, 4, 4, 3)))
    renderer = CpuRenderer(world, threads=2)
    cameras = {
        "pinhole": camera(),
        "fisheye": camera(lens=Fisheye(24.0, 24.0, 36.0, 24.0, (0.02, -0.005, 0, 0), max_angle_rad=1.7)),
        "rolling": camera(shutter=Shutter.TOP_TO_BOTTOM),
    }
    psnr = {}
    for name, sensor in cameras.items():
        asked = request(sensor, moved(0.02, 0.1, 0.0), moved(0.09, 0.7, 0.2))
        psnr[name] = psnr_db(renderer.render_camera(asked).rgb, spec.render_camera(world, asked).rgb)
    asked = request(sensors.lidar_model("VLP-16", np.eye(4), columns=120), end_us=START_US + 100_000)
    got, expected = renderer.render_lidar(asked), spec.render_lidar(world, asked)
    _, mine, theirs = np.intersect1d(got.beam, expected.beam, return_indices=True)
    error_m = np.abs(got.range_m[mine] - expected.range_m[theirs])
    return {
        "instruction_set": simd.INSTRUCTION_SET,
        "psnr_db": {name: float(min(value, 999.0)) for name, value in psnr.items()},
        "beams": len(mine),
        "median_range_error_m": float(np.median(error_m)),
        "seconds": time.perf_counter() - began,
    }


if __name__ == "__main__":
    print(json.dumps(draw_and_compare()))


def test_a_fixed_number_is_known_when_a_kernel_is_compiled():
    """Each has machine code of its own, without the branches that it does not take."""
    emitted = []

    @vector_kernel("ni")
    def times(v, number, x):
        emitted.append(number)
        return v.b.mul(x, x.type(number))

    @inner
    def twice_or_not(number, x):
        return times(number, x) if len(number) == 2 else x + times(fixed_3, x)

    fixed_3 = fixed(3)
    assert twice_or_not(fixed(2), 10) == 20 and emitted == [2]
    assert twice_or_not(fixed(0), 10) == 40 and emitted == [2, 3]
