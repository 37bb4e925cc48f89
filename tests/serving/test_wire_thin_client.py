"""The message classes that NVIDIA's thin client imports, made from our texts by the commands of docs/serving.md."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from serving_calls import street_server
from serving_world import rig

ROOT = Path(__file__).parents[2]
CLIENT = """
import json, sys, grpc
from nre.grpc.protos import common_pb2, sensorsim_pb2, sensorsim_pb2_grpc
with grpc.insecure_channel(sys.argv[1]) as channel:
    stub = sensorsim_pb2_grpc.SensorsimServiceStub(channel)
    scenes = stub.get_available_scenes(common_pb2.Empty(), wait_for_ready=True, timeout=20)
    request = sensorsim_pb2.AvailableCamerasRequest(scene_id=scenes.scene_ids[-1])
    cameras = stub.get_available_cameras(request, timeout=20).available_cameras
print(json.dumps([sorted(scenes.scene_ids), {c.logical_id: c.rig_to_camera.vec.z for c in cameras}]))
"""


def test_generated_code_reads_what_our_server_says(tmp_path):
    pytest.importorskip("grpc_tools", reason="grpcio-tools is not installed")
    shutil.copytree(ROOT / "protos", tmp_path / "protos")
    blocks = re.findall(r"```bash\n(.*?)```", (ROOT / "docs" / "serving.md").read_text(), re.DOTALL)
    (commands,) = [block for block in blocks if "grpc_tools.protoc" in block]
    with street_server() as address:
        # The shell of the documented commands also runs the client, so that it sees what they export.
        script = f'set -e\npython() {{ "{sys.executable}" "$@"; }}\n{commands}\npython client.py {address}\n'
        (tmp_path / "client.py").write_text(CLIENT)
        done = subprocess.run(["bash", "-c", script], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    scenes, heights = json.loads(done.stdout.splitlines()[-1])
    assert scenes == ["clipgt-other", "clipgt-street"]
    assert heights == pytest.approx({name: c.rig_from_camera[2, 3] for name, c in rig().cameras.items()}, abs=1e-6)
