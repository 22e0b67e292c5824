"""Zip archives that are the same bytes for the same contents."""

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path

from uavkit.formats.atomic import atomic_path

_NO_DATE = (1980, 1, 1, 0, 0, 0)


def write_zip(path: Path, members: Mapping[str, str]) -> None:
    """Write texts by their names in the archive, in their order, whole or not at all."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, text in members.items():
            info = zipfile.ZipInfo(name, date_time=_NO_DATE)
            info.compress_type, info.external_attr, info.create_system = zipfile.ZIP_DEFLATED, 0o644 << 16, 3
            archive.writestr(info, text.encode("utf-8"))
    with atomic_path(path) as temporary:
        temporary.write_bytes(stream.getvalue())
