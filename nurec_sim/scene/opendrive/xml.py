"""Parses untrusted OpenDRIVE files; entities, which could expand without bound, are refused."""

from __future__ import annotations

from xml.etree import ElementTree

from nurec_sim.errors import ArchiveError
from nurec_sim.files.decoding import TooMuchError, check_xml


def opendrive_root(data: bytes, where: str) -> ElementTree.Element:
    """The ``<OpenDRIVE>`` element of a file's bytes.

    Raises:
        ArchiveError: not XML, damaged, too large, not UTF-8, with a document type, or not OpenDRIVE.
    """
    if b"\0" in data:  # UTF-16 would hide a document type from the search below
        raise ArchiveError(f"{where}: it holds zero bytes, as UTF-16 does; XML must be UTF-8")
    # Nested entities expand exponentially ("billion laughs"), external ones read other files.
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise ArchiveError(f"{where}: document types and entities are not read")
    try:
        check_xml(data)
        root = ElementTree.fromstring(data)
    except TooMuchError as error:
        raise ArchiveError(f"{where}: the map {error}") from None
    except (ElementTree.ParseError, ValueError, LookupError, RecursionError) as error:
        raise ArchiveError(f"{where}: no XML, or damaged ({error})") from error
    if root.tag != "OpenDRIVE":
        raise ArchiveError(f"{where}: no OpenDRIVE map, but <{ascii(root.tag)[1:41]}>")
    return root
