"""Which device renders: ``make_renderer``, ``choose_device`` and the flag of the commands."""

import ctypes

import pytest
from gpu_on_cpu.places import launcher_at
from render_scenes import camera, cloud, psnr_db, request, scene
from scene_worlds import full_scene

from nurec_sim import cli, render
from nurec_sim.errors import GpuError
from nurec_sim.render import device
from nurec_sim.render.gpu import launcher as gpu_launcher


@pytest.fixture(autouse=True)
def nothing_chosen(monkeypatch):
    monkeypatch.delenv(device.DEVICE_VARIABLE, raising=False)
    device.choose_device.cache_clear()
    yield
    device.choose_device.cache_clear()


@pytest.fixture
def no_driver(monkeypatch):
    load = ctypes.CDLL

    def missing(name, *arguments):
        if "cuda" in str(name):
            raise OSError(name)
        return load(name, *arguments)

    monkeypatch.setattr(ctypes, "CDLL", missing)


@pytest.fixture
def a_gpu(monkeypatch):
    """A machine with a GPU, whose kernels the emulator runs."""
    emulator = launcher_at("on the CPU")
    monkeypatch.setattr(device, "_cuda", lambda name: device.ChosenDevice("cuda:0", f"{name}: a GPU"))
    monkeypatch.setattr(gpu_launcher, "shared_launcher", lambda name: emulator)


def test_auto_is_the_cpu_without_a_driver_and_says_why(no_driver):
    name, reason = render.choose_device()
    assert name == "cpu" and "libcuda.so.1" in reason and "NVIDIA GPU and its driver" in reason
    assert type(render.make_renderer(scene(cloud(5)), threads=1)).__name__ == "CpuRenderer"


def test_auto_is_what_the_environment_names(monkeypatch):
    monkeypatch.setenv(device.DEVICE_VARIABLE, "cpu")
    assert render.choose_device().name == "cpu"
    device.choose_device.cache_clear()
    monkeypatch.setenv(device.DEVICE_VARIABLE, "tpu")
    with pytest.raises(GpuError, match="unknown device 'tpu'; have auto, cpu, cuda, cuda:0"):
        render.choose_device()


def test_cuda_without_a_driver_is_refused_with_what_is_missing(no_driver):
    with pytest.raises(GpuError, match=r"device 'cuda:1' cannot be used: .*libcuda.so.1.*docs/gpu.md"):
        render.make_renderer(scene(cloud(5)), "cuda:1")


@pytest.mark.parametrize("name", ["gpu", "cuda:", "cuda:x", "CPU", ""])
def test_other_names_are_refused(name):
    with pytest.raises(GpuError, match=f"unknown device '{name}'"):
        render.choose_device(name)


@pytest.mark.parametrize("wanted", ["auto", "cuda"])
def test_a_gpu_that_can_be_used_is_taken(a_gpu, wanted):
    world, asked = scene(cloud()), request(camera(40, 30))
    assert render.choose_device(wanted) == ("cuda:0", "cuda: a GPU")
    renderer = render.make_renderer(world, wanted)
    assert type(renderer).__name__ == "GpuRenderer" and renderer.scene is world
    assert psnr_db(renderer.render_camera(asked).rgb, render.spec.render_camera(world, asked).rgb) >= 60


def test_a_server_renders_where_it_is_told(a_gpu):
    from nurec_sim.serving.store import SceneStore

    world = scene(cloud(5))
    made = [SceneStore([world], device=name).get(world.id).renderer for name in ("auto", "cuda", "cpu")]
    assert [type(renderer).__name__ for renderer in made] == ["GpuRenderer", "GpuRenderer", "CpuRenderer"]


@pytest.mark.slow
def test_render_says_which_device_once_and_refuses_others(tmp_path, no_driver, capsys):
    from nurec_sim.scene import write_scene

    source = tmp_path / "scene.usdz"
    write_scene(full_scene(), source)
    cli.main(["render", str(source), "--out", str(tmp_path / "auto.png")])
    said = capsys.readouterr().err
    assert said.count("rendering on cpu: no GPU") == 1
    cli.main(["render", str(source), "--out", str(tmp_path / "cpu.png"), "--device", "cpu"])
    assert "rendering on" not in capsys.readouterr().err
    assert (tmp_path / "auto.png").read_bytes() == (tmp_path / "cpu.png").read_bytes()
    with pytest.raises(SystemExit) as stop:
        cli.main(["render", str(source), "--out", str(tmp_path / "no.png"), "--device", "cuda"])
    assert stop.value.code == 1 and "device 'cuda' cannot be used" in capsys.readouterr().err
    assert not (tmp_path / "no.png").exists()
