"""Messages of ROS 2 that the reader of bags knows; decoded from CDR by ``mcap-ros2-support``.

The definitions are written out here, since older bags do not hold any.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable
from typing import Any

from nurec_sim.errors import ClipError
from nurec_sim.logs.readers._packages import package

FORMAT = "a ROS 2 bag"
EXTRA = "ros"
IMAGES = ("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
POINTS = "sensor_msgs/msg/PointCloud2"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
ODOMETRY = "nav_msgs/msg/Odometry"
POSES = (ODOMETRY, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")

_POSE_PARTS = {
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
}
_VECTOR = {"geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z"}
_HEADER = {"std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id"}
_COVARIANCE = {"geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance"}
# A message and the messages that it is made of.
_DEFINITIONS: dict[str, tuple[str, dict[str, str]]] = {
    IMAGES[0]: ("std_msgs/Header header\nstring format\nuint8[] data", _HEADER),
    IMAGES[1]: (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
        "uint8[] data",
        _HEADER,
    ),
    POINTS: (
        "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense",
        {"sensor_msgs/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count", **_HEADER},
    ),
    CAMERA_INFO: (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\n"
        "float64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi",
        {
            "sensor_msgs/RegionOfInterest": "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\n"
            "bool do_rectify",
            **_HEADER,
        },
    ),
    TRANSFORMS: (
        "geometry_msgs/TransformStamped[] transforms",
        {
            "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\n"
            "geometry_msgs/Transform transform",
            "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
            "geometry_msgs/Quaternion": _POSE_PARTS["geometry_msgs/Quaternion"],
            **_VECTOR,
            **_HEADER,
        },
    ),
    ODOMETRY: (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
        "geometry_msgs/TwistWithCovariance twist",
        {
            **_COVARIANCE,
            "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
            "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
            **_POSE_PARTS,
            **_VECTOR,
            **_HEADER,
        },
    ),
    POSES[1]: ("std_msgs/Header header\ngeometry_msgs/Pose pose", _POSE_PARTS | _HEADER),
    POSES[2]: (
        "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose",
        _COVARIANCE | _POSE_PARTS | _HEADER,
    ),
}
KNOWN = frozenset(_DEFINITIONS)


def definition(kind: str) -> str:
    """The definition of a message with those of its parts, as bags hold it."""
    own, parts = _DEFINITIONS[kind]
    return f"\n{'=' * 80}\n".join([own, *(f"MSG: {name}\n{text}" for name, text in parts.items())])


def decode(kind: str, data: bytes) -> Any:
    """A message from its CDR bytes.

    Raises:
        ClipError: the extra is not installed, or the bytes are not such a message.
    """
    try:
        return _decoder(kind)(data)
    except ClipError:
        raise
    except Exception as error:
        raise ClipError(f"is not a readable {kind}: {error}") from error


@functools.cache
def _decoder(kind: str) -> Callable[[bytes], Any]:
    records, decoders = (package(name, EXTRA, FORMAT) for name in ("mcap.records", "mcap_ros2.decoder"))
    schema = records.Schema(id=1, name=kind, encoding="ros2msg", data=definition(kind).encode())
    decoder: Callable[[bytes], Any] = decoders.DecoderFactory().decoder_for("cdr", schema)
    return decoder


def header(data: bytes) -> tuple[int, str]:
    """Time (nanoseconds) and frame of a message that begins with a header, from its first bytes.

    Raises:
        ClipError: they are too few.
    """
    # Four bytes say the order of bytes; then seconds, nanoseconds, and the text with its length and a final zero.
    order = "<" if len(data) > 1 and data[1] & 1 else ">"
    try:
        seconds, nanoseconds, length = struct.unpack_from(f"{order}iII", data, 4)
        text = data[16 : 16 + length - 1]
        if length == 0 or len(text) != length - 1:
            raise ValueError("its frame id is cut off")
        if seconds == nanoseconds == 0:
            raise ValueError("its time is 0")
        return seconds * 1_000_000_000 + nanoseconds, text.decode()
    except (struct.error, ValueError) as error:
        raise ClipError(f"a message has no readable header: {error}") from error
