"""Seeded damage to messages and bytes: strange values, sizes, counts, and bytes that are not what they were."""

from __future__ import annotations

import random
import sys

import numpy as np

FLOAT32_MAX = float(np.finfo(np.float32).max)
STRANGE_FLOATS = (
    0.0, -0.0, 1.0, -1.0, 1e-45, 1e-30, 1e30, FLOAT32_MAX, -FLOAT32_MAX, 0.5, 255.0, 95.7, 100.5, 1e6, -7.0,
    float("nan"), float("inf"), -float("inf"),
)  # fmt: skip
STRANGE_DOUBLES = (*STRANGE_FLOATS, 5e-324, sys.float_info.max, -sys.float_info.max, 1e200)
STRANGE_UINT32 = (0, 1, 2, 3, 7, 31, 33, 90, 255, 1000, 4097, 8192, 8193, 65535, 2**31 - 1, 2**31, 2**32 - 1)
STRANGE_UINT64 = (0, 1, 4_999_999, 5_000_000, 5_500_000, 6_999_999, 7_000_000, 7_000_001, 2**62, 2**63, 2**64 - 1)
STRANGE_TEXTS = (
    "", "street", "clipgt-street", "other", "car-1", "parked-1", "front", "wide", "other/car-1", "street/", "/", "..",
    "\0", "a" * 5000, "\U0001f697", "roof", "hyperion_8_1", "no-such", "%s%n", "clipgt-", "new",
)  # fmt: skip
COUNTS = (0, 1, 2, 5, 17, 65, 1001, 5000)


def mutate(rng: random.Random, message) -> None:
    """Changes one place of a message, at any depth."""
    places = list(_places(message))
    if not places:  # it has no fields
        return
    holder, field = rng.choice(places)
    if field.type == field.TYPE_MESSAGE:
        _mutate_messages(rng, holder, field)
    elif field.is_repeated:
        _mutate_values(rng, getattr(holder, field.name), field)
    else:
        setattr(holder, field.name, value_of(rng, field))


def damage(rng: random.Random, data: bytes) -> bytes:
    """Bytes cut, overwritten, turned, doubled or put in between."""
    kind, at = rng.randrange(6), rng.randrange(len(data) + 1)
    end = min(len(data), at + rng.choice((1, 2, 4, 16, 256, 4096)))
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + rng.randbytes(end - at) + data[end:]
    if kind == 2:
        return data[:at] + bytes(rng.randrange(1, 40)) + data[end:]
    if kind == 3:
        return data[:at] + data[at:end] * rng.choice((2, 3, 50)) + data[end:]
    if kind == 4:
        return data[:at] + rng.randbytes(rng.randrange(1, 40)) + data[at:]
    flipped = bytearray(data)
    for _ in range(rng.randrange(1, 9) if data else 0):
        flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(flipped)


def value_of(rng: random.Random, field):
    """A strange value of a scalar field."""
    if field.type == field.TYPE_BOOL:
        return rng.random() < 0.5
    if field.type == field.TYPE_ENUM:
        return rng.choice((-1, 0, 1, 2, 3, 4, 5, 6, 7, 77, 2**31 - 1, -(2**31)))
    if field.type == field.TYPE_STRING:
        return rng.choice(STRANGE_TEXTS)
    if field.type == field.TYPE_BYTES:
        return rng.randbytes(rng.choice((0, 1, 100)))
    if field.type == field.TYPE_FLOAT:
        return rng.choice(STRANGE_FLOATS) if rng.random() < 0.7 else np.float32(rng.uniform(-3, 3)).item()
    if field.type == field.TYPE_DOUBLE:
        return rng.choice(STRANGE_DOUBLES) if rng.random() < 0.7 else rng.uniform(-400, 400)
    if field.type in (field.TYPE_FIXED64, field.TYPE_UINT64):
        return rng.choice(STRANGE_UINT64)
    return rng.choice(STRANGE_UINT32) if rng.random() < 0.7 else rng.randrange(300)


def _places(message):
    """(message, field) of all fields of a message and of those in it that are set."""
    for field in message.DESCRIPTOR.fields:
        yield message, field
        if field.type != field.TYPE_MESSAGE or field.message_type.GetOptions().map_entry:
            continue
        if field.is_repeated:
            for entry in list(getattr(message, field.name))[:4]:
                yield from _places(entry)
        elif message.HasField(field.name):
            yield from _places(getattr(message, field.name))


def _mutate_messages(rng: random.Random, holder, field) -> None:
    """A message field taken away, set to nothing, or repeated."""
    if not field.is_repeated:
        if rng.random() < 0.5:
            holder.ClearField(field.name)
        else:
            getattr(holder, field.name).SetInParent()
        return
    entries = getattr(holder, field.name)
    kind = rng.randrange(3)
    if kind == 0 or not len(entries):
        entries.add()
    elif kind == 1:
        del entries[rng.randrange(len(entries)) :]
    else:
        first = type(entries[0])()
        first.CopyFrom(entries[0])
        size = max(1, first.ByteSize())
        entries.extend([first] * min(rng.choice(COUNTS), 2_000_000 // size))


def _mutate_values(rng: random.Random, values, field) -> None:
    """A list of scalars with one strange value, or of another length."""
    if len(values) and rng.random() < 0.5:
        values[rng.randrange(len(values))] = value_of(rng, field)
        return
    count = rng.choice((*COUNTS, 16, 100_000))
    one = value_of(rng, field)
    del values[:]
    values.extend([one] * count if count > 100 else [value_of(rng, field) for _ in range(count)])
