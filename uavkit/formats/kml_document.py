"""The XML of KML and KMZ, opened safely: bounded in size, and without document type, so that no entity is expanded."""

import re
import zipfile
import zlib
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

from uavkit.core.errors import InputError

LARGEST_BYTES = 256 * 1024 * 1024
"""Of a document, unpacked."""


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


def _kml_bytes(path: Path) -> bytes:
    try:
        if not zipfile.is_zipfile(path):
            return path.read_bytes()
        with zipfile.ZipFile(path) as archive:
            names = [info for info in archive.infolist() if info.filename.lower().endswith(".kml")]
            if not names:
                raise InputError(f"{path}: this KMZ holds no .kml file: export it again")
            main = next((info for info in names if info.filename.lower() == "doc.kml"), names[0])
            if main.file_size > LARGEST_BYTES:
                raise InputError(f"{path}: {main.filename} would unpack to {main.file_size} bytes: that is no flight")
            return archive.read(main)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise InputError(f"{path}: the KMZ is damaged ({error}): export it again") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error


def _parse(path: Path, content: bytes) -> ElementTree.Element:
    """Return the root element; a first pass refuses a DTD before anything could be expanded."""

    def refuse(*_: object) -> None:
        raise InputError(f"{path}: a document type declaration (DTD) is not accepted in KML: remove the DOCTYPE line")

    guard = expat.ParserCreate()
    guard.StartDoctypeDeclHandler = refuse
    try:
        guard.Parse(content, True)
        return ElementTree.fromstring(content)
    except (expat.ExpatError, ElementTree.ParseError, LookupError, ValueError) as error:  # encodings too
        raise InputError(f"{path}: no valid KML ({error}): export it again") from error
