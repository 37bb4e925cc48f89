"""Binary USD layers and arrays that claim more than they hold are refused before memory is taken."""

import io
import struct
from dataclasses import replace

import numpy as np
import pytest
from scene_worlds import full_scene

from nurec_sim.errors import ArchiveError
from nurec_sim.files import decoding
from nurec_sim.files.npy import array_from_npy, npy_bytes
from nurec_sim.scene.usd import crate_arrays
from nurec_sim.scene.usd.crate_check import check_crate
from nurec_sim.scene.usd.layers import static_layer


@pytest.fixture(scope="module")
def crate():
    return static_layer(full_scene(0).static)


def contents(crate):
    """Place of the table of contents, and of each section's entry in it by name."""
    (at,) = struct.unpack_from("<Q", crate, 16)
    (count,) = struct.unpack_from("<Q", crate, at)
    places = [at + 8 + 32 * i for i in range(count)]
    return at, {crate[place : place + 16].rstrip(b"\0").decode(): place for place in places}


def changed(crate, at, number):
    return crate[:at] + struct.pack("<Q", number) + crate[at + 8 :]


def refused(data, text):
    with pytest.raises(ArchiveError, match=text) as caught:
        check_crate(io.BytesIO(data), "a.usdz: b.usdc")
    assert str(caught.value).startswith("a.usdz: b.usdc is no readable USD layer: ")


def test_sound_layers_and_text_layers_pass(crate):
    check_crate(io.BytesIO(crate), "x")
    check_crate(io.BytesIO(b"#usda 1.0\n"), "x")
    check_crate(io.BytesIO(b""), "x")


def test_a_table_of_contents_that_is_none(crate):
    at, _ = contents(crate)
    refused(changed(crate, 16, 2**63), "it refers to byte 9,223,372,036,854,775,808")
    refused(changed(crate, 16, len(crate)), "it breaks off")
    refused(changed(crate, at, 2**60), "it claims 1,152,921,504,606,846,976 sections")
    refused(crate[:40], "it breaks off")


@pytest.mark.parametrize("name", ["TOKENS", "STRINGS", "FIELDS", "FIELDSETS", "PATHS", "SPECS"])
def test_sections_that_cannot_hold_what_they_claim(crate, name):
    _, entries = contents(crate)
    start, length = struct.unpack_from("<QQ", crate, entries[name] + 16)
    refused(changed(crate, start, 2**40), f"section {name} claims 1,099,511,627,776 entries in {length:,} bytes")
    refused(changed(crate, entries[name] + 24, 2**40), "ends beyond it")


def test_names_that_claim_too_many_bytes(crate):
    _, entries = contents(crate)
    (start,) = struct.unpack_from("<Q", crate, entries["TOKENS"] + 16)
    refused(changed(crate, start + 8, 2**40), "its names claim 1,099,511,627,776 bytes")
    old = crate[:8] + bytes([0, 3, 0]) + crate[11:]
    try:  # before 0.4.0 there is text in this place, and fields are not packed
        check_crate(io.BytesIO(changed(old, start + 16, 2**40)), "x")
    except ArchiveError as error:
        assert "names claim" not in str(error)


@pytest.mark.parametrize("header", [b"{'descr': '<f4', 'shape': (", b"(" * 4000, b"{'descr': '<f4'", b"\xff\xfe"])
def test_array_headers_that_are_no_python(header):
    good = npy_bytes(full_scene(0).static.opacity)
    bad = good[:8] + struct.pack("<H", len(header)) + header + good[-400:]
    with pytest.raises(ArchiveError, match="x is no array file"):
        array_from_npy(bad, "x")


def layer_of(path, values, *, at_times=False):
    """A layer with one attribute of numbers, that OpenUSD packs if all are whole or few differ."""
    from pxr import Sdf, Usd, Vt

    stage = Usd.Stage.CreateNew(str(path))
    attribute = stage.DefinePrim("/a", "Scope").CreateAttribute("opacities", Sdf.ValueTypeNames.FloatArray)
    for time in (1.0, 2.0) if at_times else (Usd.TimeCode.Default(),):
        attribute.Set(Vt.FloatArray.FromNumpy(values), time)
    stage.Save()
    return path.read_bytes()


@pytest.mark.parametrize("at_times", [False, True])
def test_packed_arrays_are_counted_before_they_are_unpacked(tmp_path, monkeypatch, at_times):
    """5 million zeros make a file of less than 20 kB."""
    monkeypatch.setattr(decoding, "LIMITS", replace(decoding.LIMITS, free_bytes=1 << 20))
    data = layer_of(tmp_path / "a.usdc", np.zeros(5_000_000, np.float32), at_times=at_times)
    assert len(data) < 20_000
    with pytest.raises(ArchiveError, match=r"x: its packed arrays may unpack to 40,000,000 bytes or more; at most"):
        check_crate(io.BytesIO(data), "x")
    sound = layer_of(tmp_path / "b.usdc", np.zeros(50_000, np.float32), at_times=at_times)
    check_crate(io.BytesIO(sound), "x")


def test_what_the_fields_say_is_what_openusd_reads(tmp_path):
    """An array of 70,000 zeros, found by its word."""
    data = layer_of(tmp_path / "a.usdc", np.zeros(70_000, np.float32))
    _, entries = contents(data)
    (start,) = struct.unpack_from("<Q", data, entries["FIELDS"] + 16)
    words = crate_arrays._words(io.BytesIO(data), start, tuple(data[8:11]), "x")
    packed = [word for word in words if word >> 61 == 0b101]
    assert len(packed) == 1 and packed[0] >> 48 & 255 == 8  # of floats
    assert crate_arrays._length(io.BytesIO(data), packed[0] & (1 << 48) - 1, tuple(data[8:11]), "x") == 70_000


def test_fields_that_cannot_be_unpacked(crate):
    _, entries = contents(crate)
    start, length = struct.unpack_from("<QQ", crate, entries["FIELDS"] + 16)
    (names,) = struct.unpack_from("<Q", crate, start + 8)
    refused(changed(crate, start + 16 + names, 2**40), "fields claim 1,099,511,627,776 bytes")
    at = start + 24 + names
    refused(crate[:at] + b"\0\x0f\xff\xff" + crate[at + 4 :], "its fields cannot be unpacked")
