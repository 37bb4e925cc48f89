"""Road maps for other simulators: ``map.xodr`` and the parquet tables of ``clipgt/``."""

from __future__ import annotations

import io
import re
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float64

from nurec_sim.errors import ArchiveError
from nurec_sim.files.decoding import LIMITS
from nurec_sim.scene.interop.validate.alpasim_roads import check_roads
from nurec_sim.scene.interop.validate.contents import Contents, entry_of, numbers_of
from nurec_sim.scene.interop.validate.finding import Report
from nurec_sim.scene.opendrive.xml import opendrive_root

XODR = "map.xodr"
MAP_FOLDERS = ("map_data", "clipgt", "fastmap")
CLIPGT_TABLES = ("lane", "association", "road_boundary", "clip", "traffic_sign", "wait_line")
MAX_TABLE_BYTES = 256 * 2**20


def check_alpasim_map(
    report: Report, contents: Contents, rig: dict[str, Any] | None, world_from_rig: Float64[np.ndarray, "t 4 4"] | None
) -> None:
    """Adds findings on the map used by AlpaSim: the first existing folder, else ``map.xodr``.

    Args:
        report: collects the findings.
        contents: the archive.
        rig: contents of ``rig_trajectories.json``; None skips the checks that need it.
        world_from_rig: [t,4,4] recorded poses of the rig; None skips the checks along the path.
    """
    folder = next((name for name in MAP_FOLDERS if contents.folder(name)), None)
    if folder == "clipgt":
        with report.rule("clipgt"):
            _check_clipgt(contents)
    elif folder is None and XODR not in contents:
        report.add("map", f"the archive has neither {', '.join(f'{name}/' for name in MAP_FOLDERS)} nor {XODR}")
    elif folder is None:
        with report.rule("xodr"):
            root = road_root(contents)
            if georeference(root) is None:
                raise ArchiveError(f"{XODR} has no geoReference")
            if rig is not None and world_from_rig is not None:
                check_roads(report, contents, root, rig, world_from_rig)
        if rig is not None:
            with report.rule("base-frame"):
                check_base_frame(rig)


def check_base_frame(rig: dict[str, Any]) -> None:
    """Checks ``T_world_base``.

    Raises:
        ArchiveError: missing or malformed.
    """
    name = "rig_trajectories.json"
    numbers_of(entry_of(rig, "T_world_base", name), f"{name}: T_world_base", 4, 4)


def road_root(contents: Contents) -> ElementTree.Element:
    """The root of ``map.xodr`` with at least one road.

    Raises:
        ArchiveError: missing, damaged, no OpenDRIVE, or without roads.
    """
    root = opendrive_root(contents.read(XODR, LIMITS.xml_bytes), XODR)
    if root.find("road") is None:
        raise ArchiveError(f"{XODR} has no road")
    return root


def georeference(root: ElementTree.Element) -> str | None:
    """The projection text of a map, None if there is none."""
    text = root.findtext("header/geoReference")
    return text.strip() if text and text.strip() else None


def geodetic_origin(text: str | None) -> tuple[float, float] | None:
    """(latitude, longitude) in degrees from a projection text, None if missing."""
    found = [re.search(rf"\+{name}_0=([-+0-9.eE]+)", text or "") for name in ("lat", "lon")]
    try:
        latitude, longitude = (float(match.group(1)) for match in found if match)
    except ValueError:
        return None
    return latitude, longitude


def _check_clipgt(contents: Contents) -> None:
    """Checks that a ``clipgt/`` folder is a usable map.

    Raises:
        ArchiveError: a table is missing, unreadable, or has no usable lane.
    """
    missing = [name for name in CLIPGT_TABLES if f"clipgt/{name}.parquet" not in contents]
    if missing:
        raise ArchiveError(f"clipgt/ lacks {', '.join(f'{name}.parquet' for name in missing)}")
    for name in CLIPGT_TABLES:
        rows = _table(contents, f"clipgt/{name}.parquet", name)
        if name != "lane":
            continue
        if not rows:
            raise ArchiveError("clipgt/lane.parquet has no lane")
        for number, lane in enumerate(rows):
            rails = [lane.get(side) for side in ("left_rail", "right_rail")] if isinstance(lane, dict) else [None]
            lengths = [len(rail) if isinstance(rail, list) else 0 for rail in rails]
            if min(lengths) < 2 or len(set(lengths)) > 1:
                raise ArchiveError(f"clipgt/lane.parquet: lane {number} has rails of {lengths} points")


def _table(contents: Contents, name: str, payload: str) -> list[Any]:
    """The payload column of a clipgt table; its ``key`` column is checked."""
    import polars

    data = contents.read(name, MAX_TABLE_BYTES)
    try:
        rows = polars.scan_parquet(io.BytesIO(data)).select(polars.len()).collect().item()  # from the file's last bytes
        if rows > LIMITS.table_rows:
            raise ArchiveError(f"{name} has {rows:,} rows; at most {LIMITS.table_rows:,} are read")
        table = polars.read_parquet(io.BytesIO(data))
    except (polars.exceptions.PolarsError, OSError, ValueError, polars.exceptions.PanicException) as error:
        raise ArchiveError(f"{name} is no readable parquet table ({str(error)[:200]})") from None
    lacking = {"key", payload} - set(table.columns)
    if lacking:
        raise ArchiveError(f"{name} has the columns {table.columns}, not {', '.join(sorted(lacking))}")
    key = table.schema["key"]
    fields = {field.name for field in key.fields} if isinstance(key, polars.Struct) else set()
    if not {"clip_id", "map_id", "kind"} <= fields:
        raise ArchiveError(f"{name}: the column key has the fields {sorted(fields)}, not clip_id, map_id, kind")
    return table[payload].to_list()
