"""The CUDA kernels compile for every architecture without a GPU, and are kept on disk."""

import subprocess
import sys

import numpy as np
import pytest

from nurec_sim.errors import GpuError
from nurec_sim.render.gpu import compiler
from nurec_sim.render.gpu.launcher import CudaLauncher, as_scalar


@pytest.fixture(autouse=True)
def needs_compiler():
    pytest.importorskip("cuda.core", reason="the extra 'gpu' is not installed")


@pytest.fixture
def nvrtc():
    from cuda.pathfinder import DynamicLibNotFoundError, load_nvidia_dynamic_lib

    try:
        load_nvidia_dynamic_lib("nvrtc")
    except DynamicLibNotFoundError as error:
        pytest.skip(f"NVRTC, which compiles the kernels, is not found: {error}")


@pytest.mark.usefixtures("nvrtc")
@pytest.mark.parametrize("architecture", ["sm_80", "sm_90", "sm_120"])
def test_compiles_without_warnings_spills_or_local_memory(architecture):
    cubin, log = compiler.compile_cubin(architecture)
    assert cubin[:4] == b"\x7fELF"
    assert log == ""
    assert all(name.encode() in cubin for name in compiler.kernel_names())


def test_every_kernel_is_found():
    assert {"project", "blend", "blend_backward", "project_backward", "finish_beams"} <= set(compiler.kernel_names())
    text = "".join(path.read_text() for path in compiler.kernel_sources())
    assert text.count("__global__") == len(compiler.kernel_names()) == len(set(compiler.kernel_names()))


def test_unknown_architecture():
    with pytest.raises(GpuError, match="cannot compile the kernels for sm_7"):
        compiler.compile_cubin("sm_7")


@pytest.mark.usefixtures("nvrtc")
def test_cubins_are_kept_by_source_and_architecture(tmp_path, monkeypatch):
    calls = []

    def compile_cubin(architecture):
        calls.append(architecture)
        return b"code of " + architecture.encode(), ""

    monkeypatch.setattr(compiler, "compile_cubin", compile_cubin)
    for architecture in ("sm_90", "sm_120", "sm_90", "sm_120"):
        assert compiler.cached_cubin(architecture, tmp_path) == b"code of " + architecture.encode()
    assert calls == ["sm_90", "sm_120"]
    assert len(list(tmp_path.iterdir())) == 2
    monkeypatch.setattr(compiler, "PTXAS_OPTIONS", ())
    compiler.cached_cubin("sm_90", tmp_path)
    assert calls == ["sm_90", "sm_120", "sm_90"]


@pytest.mark.usefixtures("nvrtc")
def test_a_folder_that_cannot_be_used_costs_a_compilation_only(tmp_path, monkeypatch):
    monkeypatch.setattr(compiler, "compile_cubin", lambda architecture: (b"code", ""))
    blocked = tmp_path / "file"
    blocked.write_text("no folder")
    assert compiler.cached_cubin("sm_90", blocked / "cubins") == b"code"
    monkeypatch.setenv("NUREC_SIM_CACHE", str(tmp_path / "cache"))
    compiler.cached_cubin("sm_90")
    assert list((tmp_path / "cache" / "cubins").glob("sm_90-*.cubin"))


def test_without_a_gpu_the_error_says_what_is_needed():
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with pytest.raises(GpuError, match="no GPU: .*(CUDA build of torch|NVIDIA GPU and its driver)"):
        CudaLauncher()


def test_arguments_of_kernels_have_the_sizes_that_cuda_reads():
    torch = pytest.importorskip("torch")
    device, plane = torch.device("cpu"), torch.zeros(4, 6)
    given = [as_scalar(value, device) for value in (plane, None, 3, 0.5, np.int64(7))]
    assert [value.dtype for value in given] == [np.uint64, np.uint64, np.int32, np.float32, np.int64]
    assert [int(value) for value in given] == [plane.data_ptr(), 0, 3, 0, 7]
    with pytest.raises(ValueError, match="contiguous tensors on cpu"):
        as_scalar(plane.T, device)


def test_rendering_on_the_cpu_imports_nothing_of_it():
    program = (
        "import sys, nurec_sim.render, nurec_sim.render.cpu.renderer, nurec_sim.cli.verbs; "
        "assert not any(m.startswith(('cuda.', 'nurec_sim.render.gpu')) for m in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
