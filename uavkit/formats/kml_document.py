"""The XML of KML and KMZ, opened safely: bounded in size, and without document type, so that no entity is expanded."""

import re
import zipfile
import zlib
from pathlib import Path
from typing import IO
from xml.etree import ElementTree
from xml.parsers import expat

from uavkit.core.errors import InputError
from uavkit.formats.xml_records import LARGEST_BYTES as LARGEST_BYTES
from uavkit.formats.xml_records import MOST_DEPTH

MOST_ELEMENTS = 1_000_000
"""Of a document that is held whole."""
_LARGEST_HELD_BYTES = 64 * 1024 * 1024


def read_kml(path: Path) -> ElementTree.Element:
    """Return the root element of a KML file, or of the main document of a KMZ; raises InputError naming the file."""
    return _parse(path, _kml_bytes(path))


def local_name(element: ElementTree.Element) -> str:
    """Return an element's name without its namespace."""
    return element.tag.rpartition("}")[2]


def child_text(element: ElementTree.Element, name: str) -> str:
    """Return the text of the first child of a name, stripped; empty where there is none."""
    return next((child.text or "" for child in element if local_name(child) == name), "").strip()


def coordinate_tuples(text: str) -> list[list[str]]:
    """Return the numbers, as text, of each tuple of ``coordinates``; blanks about the commas are forgiven."""
    return [part.split(",") for part in re.sub(r"\s*,\s*", ",", text).split()]


def main_document(path: Path, archive: zipfile.ZipFile) -> zipfile.ZipInfo:
    """Return the entry of a KMZ's main document: doc.kml, else the first .kml; raises InputError where there is none.

    Its size is what the archive says, which may be false: unpack it with a limit.
    """
    names = [info for info in archive.infolist() if info.filename.lower().endswith(".kml")]
    if not names:
        raise InputError(f"{path}: this KMZ holds no .kml file: export it again")
    return next((info for info in names if info.filename.lower() == "doc.kml"), names[0])


def _kml_bytes(path: Path) -> bytes:
    try:
        if not zipfile.is_zipfile(path):
            with path.open("rb") as stream:
                return _bounded(path, stream)
        with zipfile.ZipFile(path) as archive, archive.open(main_document(path, archive)) as unpacked:
            return _bounded(path, unpacked)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise InputError(f"{path}: the KMZ is damaged ({error}): export it again") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error


def _bounded(path: Path, stream: IO[bytes]) -> bytes:
    """Return the bytes of a stream, whatever size its archive tells; raises InputError where they are too many."""
    content = stream.read(_LARGEST_HELD_BYTES + 1)
    if len(content) > _LARGEST_HELD_BYTES:
        raise InputError(f"{path}: would unpack to more than {_LARGEST_HELD_BYTES} bytes: that is no flight")
    return content


def _parse(path: Path, content: bytes) -> ElementTree.Element:
    """Return the root element; a first pass refuses a DTD, depth and number before anything is built."""
    depth = count = 0

    def refuse(*_: object) -> None:
        raise InputError(f"{path}: a document type declaration (DTD) is not accepted in KML: remove the DOCTYPE line")

    def started(*_: object) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > MOST_DEPTH or count > MOST_ELEMENTS:
            raise InputError(f"{path}: more than {MOST_ELEMENTS} elements, or {MOST_DEPTH} deep: that is no flight")

    def ended(*_: object) -> None:
        nonlocal depth
        depth -= 1

    guard = expat.ParserCreate()
    guard.StartDoctypeDeclHandler, guard.StartElementHandler, guard.EndElementHandler = refuse, started, ended
    try:
        guard.Parse(content, True)
        return ElementTree.fromstring(content)
    except (expat.ExpatError, ElementTree.ParseError, LookupError, ValueError) as error:  # encodings too
        raise InputError(f"{path}: no valid KML ({error}): export it again") from error
