"""Surface classes of the world, their labels and LiDAR reflectivities."""

from __future__ import annotations

import enum

import numpy as np

from nurec_sim.types import Label


class SurfaceClass(enum.IntEnum):
    """Class of a pixel or a LiDAR return in the ground truth."""

    SKY = 0
    ROAD = 1
    MARKING = 2
    KERB = 3
    SIDEWALK = 4
    GRASS = 5
    BUILDING = 6
    VEGETATION = 7
    POLE = 8
    VEHICLE = 9
    PERSON = 10
    CYCLIST = 11
    FENCE = 12
    FURNITURE = 13
    SIGN = 14
    ISLAND = 15


# Fraction of a laser's light that is reflected: retroreflecting signs and paint are bright, asphalt is dark.
REFLECTIVITY = {
    SurfaceClass.SKY: 0.0,
    SurfaceClass.ROAD: 0.12,
    SurfaceClass.MARKING: 0.65,
    SurfaceClass.KERB: 0.30,
    SurfaceClass.SIDEWALK: 0.25,
    SurfaceClass.GRASS: 0.35,
    SurfaceClass.BUILDING: 0.35,
    SurfaceClass.VEGETATION: 0.45,
    SurfaceClass.POLE: 0.40,
    SurfaceClass.VEHICLE: 0.45,
    SurfaceClass.PERSON: 0.30,
    SurfaceClass.CYCLIST: 0.32,
    SurfaceClass.FENCE: 0.35,
    SurfaceClass.FURNITURE: 0.35,
    SurfaceClass.SIGN: 0.90,
    SurfaceClass.ISLAND: 0.30,
}

LABEL_OF_CLASS = np.full(len(SurfaceClass), Label.OTHER, np.uint8)
LABEL_OF_CLASS[SurfaceClass.SKY] = Label.SKY
LABEL_OF_CLASS[[SurfaceClass.ROAD, SurfaceClass.MARKING]] = Label.ROAD
LABEL_OF_CLASS[[SurfaceClass.VEHICLE, SurfaceClass.PERSON, SurfaceClass.CYCLIST]] = Label.MOVABLE
"""``types.Label`` of every ``SurfaceClass``."""
