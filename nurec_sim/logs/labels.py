"""Object labels of other data sets mapped to ours (``types.MOVABLE_LABELS``)."""

from __future__ import annotations

from nurec_sim.types import MOVABLE_LABELS

_SAME = {
    "automobile": ("car", "van", "suv", "vehicle", "pickup", "regular_vehicle"),
    "heavy_truck": ("truck", "lorry", "semi_truck", "large_vehicle", "box_truck", "truck_cab"),
    "bus": ("bus/rv/caravan", "bendy_bus", "rigid_bus", "articulated_bus", "school_bus"),
    "train": ("tram", "train_or_tram_car", "railed_vehicle"),
    "trailer": ("vehicular_trailer",),
    "other_vehicle": ("misc", "other", "construction_vehicle", "emergency_vehicle", "towed_object", "wheeled_slow"),
    "person": ("pedestrian", "person_sitting", "stroller", "wheelchair", "official_signaler"),
    # A parked bicycle may start to move as well.
    "rider": (
        "cyclist",
        "motorcyclist",
        "bicycle",
        "bicyclist",
        "motorcycle",
        "motorized_slow",
        "wheeled_rider",
        "wheeled_device",
    ),
    "animal": ("dog",),
}
_OURS = {other: label for label, others in _SAME.items() for other in others}
IGNORED = frozenset({"dontcare"})


def our_label(given: str) -> str:
    """Our label for a label of another data set; unknown ones are kept, in lower case."""
    label = given.strip().lower().replace(" ", "_")
    return _OURS.get(label, label)


def is_movable(label: str) -> bool:
    """Whether objects of this label (one of ours) can move by themselves; a traffic cone cannot."""
    return label in MOVABLE_LABELS
