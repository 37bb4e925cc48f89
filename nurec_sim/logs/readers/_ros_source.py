"""The images and sweeps of a ROS 2 bag, read message by message."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from jaxtyping import UInt8
from numpy import ndarray

from nurec_sim.logs.readers import _ros_messages as messages
from nurec_sim.logs.readers import _ros_sensors as decoding
from nurec_sim.logs.readers._ros_storage import BagFile, Key
from nurec_sim.types import SweepPoints


@dataclass(frozen=True)
class StoredMessage:
    """Where a message is, and what its header says.

    Attributes:
        file: number of the file in the bag.
        key: place in the file.
        stamp_ns: its time.
        frame: its coordinate frame.
    """

    file: int
    key: Key
    stamp_ns: int
    frame: str

    @property
    def t_us(self) -> int:
        """Its time in microseconds."""
        return round(self.stamp_ns / 1000)


@dataclass(frozen=True)
class SensorMessages:
    """The messages of one sensor.

    Attributes:
        topic: where they were published.
        rows: in the order of time.
        times: how points say when they were measured; None if they do not.
        first_us: from the time of a message to the start of its sweep.
        last_us: to its end.
        intensity_scale: divisor that maps intensities to 0..1.
    """

    topic: str
    rows: Sequence[StoredMessage]
    times: decoding.PointTimes | None = None
    first_us: int = 0
    last_us: int = 0
    intensity_scale: float = decoding.FULL_BYTE


@dataclass
class BagSource:
    """A bag as a ``types.LogSource``.

    Attributes:
        files: its files.
        kinds: the type of each topic.
        sensors: the messages of each camera and LiDAR.
    """

    files: Sequence[BagFile]
    kinds: Mapping[str, str]
    sensors: dict[str, SensorMessages] = field(default_factory=dict)

    def message(self, topic: str, at: StoredMessage) -> Any:
        """A decoded message."""
        return messages.decode(self.kinds[topic], self.files[at.file].read(topic, at.key))

    def image(self, camera_id: str, index: int) -> UInt8[ndarray, "h w 3"]:
        """One RGB frame."""
        sensor = self.sensors[camera_id]
        return decoding.picture(self.message(sensor.topic, sensor.rows[index]))

    def sweep(self, lidar_id: str, index: int) -> SweepPoints:
        """The points of one sweep."""
        sensor = self.sensors[lidar_id]
        at = sensor.rows[index]
        points = decoding.cloud(self.message(sensor.topic, at))
        dt_us = None if sensor.times is None else sensor.times.after_us(points, at.stamp_ns) - sensor.first_us
        return decoding.sweep_points(points, sensor.intensity_scale, dt_us)

    def ego_mask(self, camera_id: str) -> None:
        """Bags have none."""
        return None
