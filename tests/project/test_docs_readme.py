"""The README: its Python example runs as it stands."""

import re
from pathlib import Path

import numpy as np
import pytest
from reconstruct_street import Street

from nurec_sim import logs

README = Path(__file__).parents[2] / "README.md"


@pytest.mark.slow
def test_the_python_example_runs(tmp_path, monkeypatch):
    """In a folder with a log of that name, whose images and sweeps are those of a street with walls."""
    street = Street(frames=4)
    entries = [logs.CameraEntry("front", *map(int, street.camera_times_us("front")[i]), street.image("front", i))
               for i in range(street.frames)]  # fmt: skip
    entries += [logs.LidarEntry("top", street.sweep("top", i)) for i in range(street.frames)]
    logs.write_clip(tmp_path / "CLIP", id="street", rig=street.rig, ego=street.ego, frames=entries)
    monkeypatch.chdir(tmp_path)
    (example,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    names = {}
    exec(compile(example, "README.md", "exec"), names)
    assert (tmp_path / "scene.usdz").is_file()
    assert names["image"].rgb.dtype == np.uint8 and names["image"].rgb.shape == (96, 192, 3)
    assert len(names["sweep"].xyz_m) > 1000 and names["sweep"].xyz_m.shape[1] == 3
    assert names["rollout"].policy == "route_follower"
