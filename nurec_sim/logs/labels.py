"""Object labels of other data sets mapped to ours (``types.MOVABLE_LABELS``)."""

from __future__ import annotations

from nurec_sim.types import MOVABLE_LABELS

_SAME = {
    "automobile": ("car", "van", "suv", "vehicle", "pickup"),
    "heavy_truck": ("truck", "lorry", "semi_truck"),
    "bus": ("bus/rv/caravan", "bendy_bus", "rigid_bus"),
    "train": ("tram", "train_or_tram_car"),
    "other_vehicle": ("misc", "other", "construction_vehicle", "emergency_vehicle", "towed_object", "wheeled_slow"),
    "person": ("pedestrian", "person_sitting", "stroller", "wheelchair"),
    # A parked bicycle may start to move as well.
    "rider": ("cyclist", "motorcyclist", "bicycle", "bicyclist", "motorcycle", "motorized_slow"),
    "animal": (),
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
