"""Message classes of ``protos/``, made at import in a private descriptor pool.

Generated code of the same proto packages (AlpaSim ships some) registers itself in the process-wide pool, where a second
copy is a crash; here nothing is registered there, so both live in one process.
"""

from __future__ import annotations

import enum
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.descriptor import Descriptor

SENSORSIM = "nre.grpc.protos.sensorsim"
SERVICE = f"{SENSORSIM}.SensorsimService"
SERVICE_PATHS = (SERVICE, "nurec.grpc.protos.sensorsim.SensorsimService", "sensorsim.SensorsimService")
"""The spellings in use: clients up to 26.09 and AlpaSim; the two that the documentation of 26.10 leaves open."""
SCENE_SERVICE = "nurec_sim.v1.SceneService"

MAX_MESSAGE_BYTES = 64 << 20
"""Default limit of a request or reply; AlpaSim's clients accept no more."""


class Procedure(NamedTuple):
    """Request and reply class of one remote procedure."""

    request: Any
    reply: Any


def descriptor_bytes() -> bytes:
    """The committed descriptor set, from the installed package or from a checkout's ``protos/``."""
    try:
        folder = resources.files("nurec_sim.protos")
    except ModuleNotFoundError:
        folder = Path(__file__).parents[3] / "protos"
    return folder.joinpath("descriptors.binpb").read_bytes()


def _load_pool() -> descriptor_pool.DescriptorPool:
    private = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptor_bytes()).file:
        private.AddSerializedFile(file.SerializeToString())
    return private


pool = _load_pool()


def _class(descriptor: Descriptor) -> Any:
    return message_factory.GetMessageClass(descriptor)


def _messages(file_name: str) -> SimpleNamespace:
    types = pool.FindFileByName(file_name).message_types_by_name
    return SimpleNamespace(**{name: _class(descriptor) for name, descriptor in types.items()})


def _enum(full_name: str) -> Any:
    descriptor = pool.FindEnumTypeByName(full_name)
    return enum.IntEnum(descriptor.name, {value.name: value.number for value in descriptor.values})


common = _messages("common.proto")
sensorsim = _messages("sensorsim.proto")
egodriver = _messages("egodriver.proto")
nurec_sim_v1 = _messages("nurec_sim_v1.proto")

ImageFormat = _enum(f"{SENSORSIM}.ImageFormat")
ShutterType = _enum(f"{SENSORSIM}.ShutterType")
LidarDeviceType = _enum(f"{SENSORSIM}.LidarDeviceType")
FthetaPolynomial = _enum(f"{SENSORSIM}.FthetaCameraParam.PolynomialType")
WindshieldPolynomial = _enum(f"{SENSORSIM}.BivariateWindshieldModelParameters.ReferencePolynomial")
CameraOutput = _enum("nurec_sim.v1.CameraOutput")
SweepForm = _enum("nurec_sim.v1.SweepForm")
SceneKind = _enum("nurec_sim.v1.SceneInfo.Kind")
CustomSpin = _enum(f"{SENSORSIM}.CustomLidarModel.Spin")

METHODS = {
    method.name: Procedure(_class(method.input_type), _class(method.output_type))
    for method in pool.FindServiceByName(SERVICE).methods
}
"""Every procedure of the sensor service by name."""
