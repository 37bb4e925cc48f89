"""Both ends of the egodriver interface in code generated from the protos without our additions, for a process apart.

``python generated_driving.py FOLDER client HOST:PORT`` leads a session as AlpaSim's runtime does and prints what it
got; ``python generated_driving.py FOLDER driver`` serves a driver as AlpaSim's are, and prints its address.
"""

import importlib
import io
import json
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import grpc
import numpy as np
from generated_code import generate_like_alpasim

NOW_US, STEP_US = 2_000_000, 100_000


def import_generated(folder):
    common, sensorsim = generate_like_alpasim(Path(folder))
    sys.path.insert(0, folder)
    names = ("egodriver_pb2", "egodriver_pb2_grpc")
    return common, sensorsim, *(importlib.import_module(f"alpasim_like.v0.{name}") for name in names)


def lead_a_session(address, common, sensorsim, messages, services):
    with grpc.insecure_channel(address) as channel:
        stub = services.EgodriverServiceStub(channel)
        version = stub.get_version(common.Empty(), wait_for_ready=True, timeout=20)
        opening = messages.DriveSessionRequest(session_uuid="from-alpasim", random_seed=4)
        opening.debug_info.scene_id = "clipgt-demo"
        camera = opening.rollout_spec.vehicle.available_cameras.add(logical_id="camera_front_wide_120fov")
        lens = sensorsim.FthetaCameraParam(
            principal_point_x=159.5, principal_point_y=99.5, angle_to_pixeldist_poly=[0.0, 150.0], max_angle=1.2,
            reference_poly=sensorsim.FthetaCameraParam.ANGLE_TO_PIXELDIST,
        )  # fmt: skip
        camera.intrinsics.CopyFrom(
            sensorsim.CameraSpec(
                logical_id=camera.logical_id,
                resolution_h=200,
                resolution_w=320,
                ftheta_param=lens,
                shutter_type=sensorsim.ROLLING_TOP_TO_BOTTOM,
            )  # fmt: skip
        )
        quat = common.Quat(w=0.5, x=-0.5, y=0.5, z=-0.5)
        camera.rig_to_camera.CopyFrom(common.Pose(vec=common.Vec3(x=1.7, z=1.5), quat=quat))
        stub.start_session(opening, timeout=20)
        answers = []
        for step in range(3):
            now_us = NOW_US + 5 * step * STEP_US
            image = np.full((100, 160, 3), 90, np.uint8)
            message = messages.RolloutCameraImage(session_uuid="from-alpasim")
            message.camera_image.CopyFrom(
                messages.RolloutCameraImage.CameraImage(
                    frame_start_us=now_us - 30_000,
                    frame_end_us=now_us,
                    logical_id=camera.logical_id,
                    image_bytes=cv2.imencode(".jpg", image)[1].tobytes(),
                )  # fmt: skip
            )
            stub.submit_image_observation(message, timeout=20)
            ego = messages.RolloutEgoTrajectory(session_uuid="from-alpasim")
            ego.trajectory.poses.add(
                pose=common.Pose(vec=common.Vec3(x=100.0, y=2.5 * step), quat=common.Quat(w=2**-0.5, z=2**-0.5)),
                timestamp_us=now_us,
            )
            ego.dynamic_states.add(linear_velocity=common.Vec3(x=5.0))
            stub.submit_egomotion_observation(ego, timeout=20)
            route = messages.RouteRequest(session_uuid="from-alpasim")
            route.route.timestamp_us = now_us
            route.route.waypoints.extend(common.Vec3(x=4.0 * i) for i in range(1, 21))
            stub.submit_route(route, timeout=20)
            drive = messages.DriveRequest(session_uuid="from-alpasim", time_now_us=now_us, time_query_us=now_us)
            poses = stub.drive(drive, timeout=20).trajectory.poses
            answers.append([[p.timestamp_us, p.pose.vec.x, p.pose.vec.y, p.pose.quat.w, p.pose.quat.z] for p in poses])
        stub.close_session(messages.DriveSessionCloseRequest(session_uuid="from-alpasim"), timeout=20)
    print(json.dumps({"version": version.version_id, "answers": answers}))


def serve_a_driver(common, sensorsim, messages, services):
    class Driver(services.EgodriverServiceServicer):
        """Straight on from its newest pose at 4 m/s; counts what it is sent."""

        def __init__(self):
            self.pose, self.images, self.waypoints, self.calls = None, [], 0, []

        def start_session(self, request, context):
            self.calls.append("start_session")
            self.cameras = [camera.logical_id for camera in request.rollout_spec.vehicle.available_cameras]
            return common.SessionRequestStatus()

        def close_session(self, request, context):
            return common.Empty()

        def submit_image_observation(self, request, context):
            image = request.camera_image
            pixels = cv2.imdecode(np.frombuffer(image.image_bytes, np.uint8), cv2.IMREAD_COLOR)
            self.images.append((image.logical_id, pixels.shape))
            return common.Empty()

        def submit_egomotion_observation(self, request, context):
            self.pose = request.trajectory.poses[-1]
            return common.Empty()

        def submit_route(self, request, context):
            self.waypoints = len(request.route.waypoints)
            return common.Empty()

        def drive(self, request, context):
            if self.pose.timestamp_us != request.time_now_us or not self.images or not self.waypoints:
                context.abort(grpc.StatusCode.FAILED_PRECONDITION, "observations are missing")
            quat = self.pose.pose.quat
            ahead = np.array([1 - 2 * (quat.y**2 + quat.z**2), 2 * (quat.x * quat.y + quat.w * quat.z)])
            reply = messages.DriveResponse()
            for i in range(51):
                sample = reply.trajectory.poses.add(timestamp_us=request.time_now_us + i * STEP_US)
                sample.pose.CopyFrom(self.pose.pose)
                sample.pose.vec.x += 0.4 * i * ahead[0]
                sample.pose.vec.y += 0.4 * i * ahead[1]
            print(json.dumps([self.cameras, self.images[-1], self.waypoints]), flush=True)
            return reply

        def get_version(self, request, context):
            return common.VersionId(version_id="theirs")

    server = grpc.server(ThreadPoolExecutor(4))
    services.add_EgodriverServiceServicer_to_server(Driver(), server)
    print(f"127.0.0.1:{server.add_insecure_port('127.0.0.1:0')}", flush=True)
    server.start()
    sys.stdin.read()  # until the test closes it
    server.stop(None).wait()


if __name__ == "__main__":
    out, sys.stdout = sys.stdout, io.StringIO()  # protoc may chat
    code = import_generated(sys.argv[1])
    sys.stdout = out
    if sys.argv[2] == "client":
        lead_a_session(sys.argv[3], *code)
    else:
        serve_a_driver(*code)
