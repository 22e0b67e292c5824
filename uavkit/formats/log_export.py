"""Flight logs for other programs: CSV, KML, GPX, Parquet; all written whole or not at all.

CSV and Parquet hold each table in a file of its own with all its columns (``log_tables``); CSV is read back exactly by
``csv_log``. KML holds the track (gx:Track) and the exposures as points, GPX the track and the exposures as waypoints;
both count heights from the geoid, so ellipsoidal ones are converted (EGM96), and heights above home are left out of
GPX. What is unknown is an empty cell, or no element. Times become UTC.
"""

import csv
import re
from collections.abc import Callable, Iterator
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from uavkit.core.arrays import Array
from uavkit.core.errors import InputError
from uavkit.core.flight_log import ExposureTable, FixTable, FixType, FlightLog
from uavkit.core.frames import geoid_undulation_m
from uavkit.core.gpstime import NO_TIME
from uavkit.formats.atomic import atomic_path
from uavkit.formats.log_tables import (
    MARK,
    NAMES,
    UNKNOWN_CODE,
    Role,
    TableColumns,
    columns_of,
    escaped,
    table_of,
    unix_ns_of,
    utc_texts,
)

_ROWS_AT_ONCE = 20_000


class ExportKind(Enum):
    """What a log is written as."""

    CSV = "csv"
    KML = "kml"
    GPX = "gpx"
    PARQUET = "parquet"


def export_log(log: FlightLog, path: Path, kind: ExportKind) -> tuple[Path, ...]:
    """Write a log; return the files. ``path`` is a file of the kind (its suffix says so), or a folder.

    In a folder the files are named like the log. The tables of CSV and Parquet add their names: flight_fixes.csv,
    flight_exposures.csv; tables without rows are left out. Raises InputError where there is nothing to write, or it
    cannot be written.
    """
    suffix = f".{kind.value}"
    stem = path.with_suffix("") if path.suffix.lower() == suffix else path / Path(log.source).stem
    if kind in (ExportKind.KML, ExportKind.GPX):
        if not len(_places(log.fix_table)) and not len(_places(log.exposure_table)):
            raise InputError(f"{log.source}: no position in it that could be written as {kind.name}")
        written = stem.with_name(stem.name + suffix)
        _check_not_the_log(log, written)
        (_write_kml if kind is ExportKind.KML else _write_gpx)(log, written)
        return (written,)
    write: Callable[[FlightLog, Role, Path], None] = _write_csv if kind is ExportKind.CSV else _write_parquet
    files = []
    for role in Role:
        if len(table_of(log, role)):
            files.append(stem.with_name(f"{stem.name}_{role.value}{suffix}"))
            _check_not_the_log(log, files[-1])
            write(log, role, files[-1])
    if not files:
        raise InputError(f"{log.source}: no positions, attitudes or exposures in it to write")
    return tuple(files)


def _check_not_the_log(log: FlightLog, path: Path) -> None:
    """Raise InputError where a file to be written is the log itself: what it was read from would be lost."""
    try:
        same = path.samefile(log.source)
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
    if same:
        raise InputError(f"{path}: is the log itself, which is never changed: give another folder")


def _write_csv(log: FlightLog, role: Role, path: Path) -> None:
    columns = columns_of(table_of(log, role), role)
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as stream:
        stream.write(f"{MARK}{role.value}\n")
        if log.vehicle:
            stream.write(f"# vehicle: {escaped(log.vehicle)}\n")
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(_header(columns))
        for begin in range(0, len(columns), _ROWS_AT_ONCE):
            writer.writerows(_cells(columns, slice(begin, begin + _ROWS_AT_ONCE)))


def _header(columns: TableColumns) -> list[str]:
    names = ["name"] if columns.names else []
    return ["utc", *columns.times, *columns.numbers, *columns.codes, *names]


def _cells(columns: TableColumns, rows: slice) -> Iterator[tuple[str, ...]]:
    """Return the cells of some rows: repr gives back each float exactly."""
    cells = [utc_texts(columns.times["gps_time_ns"][rows])]
    for times in columns.times.values():
        cells.append(["" if time == NO_TIME else str(time) for time in times[rows].tolist()])
    for numbers in columns.numbers.values():
        cells.append([repr(value) if known else "" for value, known in _told(numbers[rows])])
    for name, codes in columns.codes.items():
        cells.append([_code_text(name, code) for code in codes[rows].tolist()])
    if columns.names:
        cells.append([escaped(name) for name in columns.names[rows]])
    return zip(*cells, strict=True)


def _told(numbers: Array) -> Iterator[tuple[float, bool]]:
    return zip(numbers.tolist(), np.isfinite(numbers).tolist(), strict=True)


def _code_text(name: str, code: int) -> str:
    if code == UNKNOWN_CODE.get(name):
        return ""
    return NAMES[name](code).name.lower() if name in NAMES else str(code)


def _write_parquet(log: FlightLog, role: Role, path: Path) -> None:
    pyarrow, parquet = _pyarrow(path)
    columns = columns_of(table_of(log, role), role)
    unix = unix_ns_of(columns.times["gps_time_ns"])
    utc = pyarrow.array(unix, mask=unix == NO_TIME).cast(pyarrow.timestamp("ns", tz="UTC"))
    arrays: dict[str, Any] = {"utc": utc}
    for name, times in columns.times.items():
        arrays[name] = pyarrow.array(times, mask=times == NO_TIME)
    for name, numbers in columns.numbers.items():
        arrays[name] = pyarrow.array(numbers, mask=~np.isfinite(numbers))
    for name, codes in columns.codes.items():
        texts = [_code_text(name, code) or None for code in codes.tolist()]
        arrays[name] = pyarrow.array(texts) if name in NAMES else pyarrow.array(codes, mask=_is_unknown(name, codes))
    if columns.names:
        arrays["name"] = pyarrow.array(columns.names, type=pyarrow.string())
    with atomic_path(path) as temporary:
        parquet.write_table(pyarrow.table(arrays), temporary)


def _pyarrow(path: Path) -> tuple[Any, Any]:
    """Return pyarrow and its module for Parquet: not everyone has it."""
    try:
        return import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError as error:
        raise InputError(f"{path}: Parquet needs pyarrow: pip install 'uavkit[parquet]'") from error


def _is_unknown(name: str, codes: NDArray[np.int64]) -> NDArray[np.bool_]:
    return np.asarray(codes == UNKNOWN_CODE.get(name, NO_TIME), dtype=np.bool_)


def _places(table: FixTable | ExposureTable) -> NDArray[np.int64]:
    """Return the rows (n,) with a position; fixes without a fix, and of a second receiver, are left out."""
    good = np.isfinite(table.latitude_deg) & np.isfinite(table.longitude_deg)
    if isinstance(table, FixTable):
        good &= (table.fix_type >= FixType.TWO_DIMENSIONAL) & (table.receiver == table.receiver.min(initial=255))
    return np.flatnonzero(good)


def _geoid_m(table: FixTable | ExposureTable) -> Array:
    """Return heights above the geoid, (n,): as stated, else the ellipsoidal ones by EGM96, else NaN."""
    wanted = np.isnan(table.height_geoid_m) & np.isfinite(table.height_ellipsoid_m)
    wanted &= np.isfinite(table.latitude_deg) & np.isfinite(table.longitude_deg)
    height_m = np.array(table.height_geoid_m, dtype=np.float64)
    if np.any(wanted):
        undulation_m = geoid_undulation_m(table.latitude_deg[wanted], table.longitude_deg[wanted])
        height_m[wanted] = table.height_ellipsoid_m[wanted] - undulation_m
    return height_m


def _by_mode(table: FixTable | ExposureTable) -> list[tuple[str, NDArray[np.int64], Array]]:
    """Return rows with a position by KML's altitude mode, with all heights (n,) of the mode.

    Heights above home are relative to the ground in KML, as other programs write them.
    """
    geoid_m, rows = _geoid_m(table), _places(table)
    absolute, home = np.isfinite(geoid_m[rows]), np.isfinite(table.height_above_home_m[rows])
    modes = (
        ("absolute", rows[absolute], geoid_m),
        ("relativeToGround", rows[~absolute & home], table.height_above_home_m),
        ("clampToGround", rows[~absolute & ~home], np.zeros(len(table))),
    )
    return [mode for mode in modes if len(mode[1])]


def _write_kml(log: FlightLog, path: Path) -> None:
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as stream:
        stream.write(_KML_HEAD.format(escape(xml_text(Path(log.source).name))))
        for mode, rows, height_m in _by_mode(log.fix_table):
            stream.writelines(_kml_track(log.fix_table, mode, rows, height_m))
        for mode, rows, height_m in _by_mode(log.exposure_table):
            stream.writelines(_kml_points(log.exposure_table, mode, rows, height_m))
        stream.write("</Document>\n</kml>\n")


_KML_HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">
<Document><name>{}</name>
"""


def _kml_track(table: FixTable, mode: str, rows: NDArray[np.int64], height_m: Array) -> Iterator[str]:
    """Yield a track of the positions with times, and a line of those without."""
    when = table.when.gps_ns[rows]
    timed, untimed = rows[when != NO_TIME], rows[when == NO_TIME]
    altitude = f"<altitudeMode>{mode}</altitudeMode>"
    if len(timed):
        yield f"<Placemark><name>track</name><gx:Track>{altitude}\n"
        yield from (f"<when>{utc}</when>\n" for utc in utc_texts(table.when.gps_ns[timed], "us"))
        yield from (f"<gx:coord>{text}</gx:coord>\n" for text in _coordinates(table, timed, height_m, " "))
        yield "</gx:Track></Placemark>\n"
    if len(untimed):
        yield f"<Placemark><name>positions without time</name><LineString>{altitude}<coordinates>\n"
        yield from (f"{text}\n" for text in _coordinates(table, untimed, height_m, ","))
        yield "</coordinates></LineString></Placemark>\n"


def _kml_points(table: ExposureTable, mode: str, rows: NDArray[np.int64], height_m: Array) -> Iterator[str]:
    coordinates = _coordinates(table, rows, height_m, ",")
    for row, utc, text in zip(rows.tolist(), utc_texts(table.when.gps_ns[rows], "us"), coordinates, strict=True):
        stamp = f"<TimeStamp><when>{utc}</when></TimeStamp>" if utc else ""
        place = f"<Point><altitudeMode>{mode}</altitudeMode><coordinates>{text}</coordinates></Point>"
        yield f"<Placemark><name>{escape(xml_text(_label(table, row)))}</name>{stamp}{place}</Placemark>\n"


def _coordinates(
    table: FixTable | ExposureTable, rows: NDArray[np.int64], height_m: Array, separator: str
) -> Iterator[str]:
    columns = (table.longitude_deg[rows], table.latitude_deg[rows], height_m[rows])
    for longitude, latitude, height in zip(*(column.tolist() for column in columns), strict=True):
        yield f"{longitude!r}{separator}{latitude!r}{separator}{height:.4f}"


def _label(table: ExposureTable, row: int) -> str:
    """Return the name of an exposure, else its number, else its place in the table."""
    if table.name and table.name[row]:
        return table.name[row]
    return str(int(table.sequence[row])) if table.sequence[row] >= 0 else str(row + 1)


def _write_gpx(log: FlightLog, path: Path) -> None:
    head = '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="uavkit" xmlns="{}">\n'
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as stream:
        stream.write(head.format("http://www.topografix.com/GPX/1/1"))
        stream.writelines(_gpx_points(log.exposure_table, "wpt"))
        if len(_places(log.fix_table)):
            stream.write("<trk><trkseg>\n")
            stream.writelines(_gpx_points(log.fix_table, "trkpt"))
            stream.write("</trkseg></trk>\n")
        stream.write("</gpx>\n")


def _gpx_points(table: FixTable | ExposureTable, tag: str) -> Iterator[str]:
    """Yield points; the order of what is in them is the standard's."""
    utc, geoid_m = utc_texts(table.when.gps_ns, "us"), _geoid_m(table)
    undulation_m = table.height_ellipsoid_m - table.height_geoid_m
    for row in _places(table).tolist():
        parts = [
            ("ele", _metres(geoid_m[row])),
            ("time", utc[row]),
            ("geoidheight", _metres(undulation_m[row])),
            *_gpx_details(table, row),
        ]
        inner = "".join(f"<{name}>{text}</{name}>" for name, text in parts if text)
        place = f'lat="{table.latitude_deg[row].item()!r}" lon="{table.longitude_deg[row].item()!r}"'
        yield f"<{tag} {place}>{inner}</{tag}>\n"


def _gpx_details(table: FixTable | ExposureTable, row: int) -> list[tuple[str, str]]:
    if isinstance(table, ExposureTable):
        return [("name", escape(xml_text(_label(table, row))))]
    satellites = int(table.satellites[row])
    fix = _GPX_FIX.get(int(table.fix_type[row]), "")
    return [("fix", fix), ("sat", "" if satellites == UNKNOWN_CODE["satellites"] else str(satellites))]


_GPX_FIX: dict[int, str] = {
    FixType.TWO_DIMENSIONAL: "2d",
    FixType.THREE_DIMENSIONAL: "3d",
    FixType.DIFFERENTIAL: "dgps",
    FixType.RTK_FLOAT: "dgps",
    FixType.RTK_FIXED: "dgps",
}


def _metres(value: float) -> str:
    return f"{value:.4f}" if np.isfinite(value) else ""


def xml_text(text: str) -> str:
    """Return a text without the characters that XML does not allow."""
    return re.sub("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", "", text)
