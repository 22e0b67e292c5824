"""How each file of ``sim_logs/broken_logs`` was made, and what must be read of it: derived from what was broken.

``PYTHONPATH=. python -m tests.sim_logs.broken_recipes`` writes the folder anew; a test holds both together.
"""

import hashlib
import io
import json
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from tests.formats import receiver_bytes as gnss
from tests.formats.tlog_bytes import Sender, frame, record
from tests.sim_logs import recorded_pieces as recorded
from tests.sim_logs.recorded_pieces import SIM_LOGS, Piece, begin_of, count, joined, nth

FOLDER = SIM_LOGS / "broken_logs"
DISTANCE, WAYPOINT = "sitl_distance_trigger", "sitl_waypoint_trigger"
GPS_STATUS, GPS_MS, GPS_WEEK, GPS_PLACE, CAM_WEEK, CAM_PLACE = 12, 13, 17, 22, 18, 20
"""Offsets in the messages GPS and CAM, head of three bytes included, by their formats in the log."""
TOW_MS = 100_018_000
"""Time of week at which the receivers' recordings begin: 2026-01-05 03:46:40 UTC."""


@dataclass(frozen=True, kw_only=True)
class Broken:
    """A file, what is wrong with it, and either words of the error or what must be found."""

    data: bytes
    defect: str
    error: str = ""
    exposures: int = 0
    fixes: int = 0
    """As ``FlightLog.fixes`` yields them: of the first receiver, those without a position left out."""
    lost_bytes: int = 0
    note: str = ""
    first_utc: str = ""
    """Begin of the time, ISO 8601, of the first fix whose time is known."""


def _dataflash(pieces: list[Piece], defect: str, *, lost: int = 0, note: str = "") -> Broken:
    """Return a log of which these messages are intact; its bytes are to be replaced where others stand in it."""
    exposures, fixes = count(pieces, "CAM"), count(pieces, "GPS")
    return Broken(data=joined(pieces), defect=defect, exposures=exposures, fixes=fixes, lost_bytes=lost, note=note)


def dataflash_cut_in_a_message() -> Broken:
    pieces = recorded.dataflash(DISTANCE)
    last = nth(pieces, "CAM", 20)
    whole = _dataflash(pieces[:last], "downloaded while it was still written: ends in the middle of a message", lost=20)
    return replace(whole, data=whole.data + pieces[last].data[:20])


def dataflash_block_of_zeros() -> Broken:
    """Zeros from the begin of a message to the middle of a later one."""
    pieces = recorded.dataflash(DISTANCE)
    first, last = nth(pieces, "CAM", 10), nth(pieces, "GPS", 110)
    begin, end = begin_of(pieces, first), begin_of(pieces, last + 1)
    left = _dataflash([*pieces[:first], *pieces[last + 1 :]], "a lost block, filled with zeros", lost=end - begin)
    zeros = bytes(end - begin - 15) + pieces[last].data[-15:]
    return replace(left, data=left.data[:begin] + zeros + left.data[begin:])


def dataflash_formats_lost() -> Broken:
    pieces = [piece for piece in recorded.dataflash(DISTANCE) if piece.name != "FMT"]
    return Broken(data=joined(pieces), defect="its beginning, which defines all messages, is lost", error="FMT")


def dataflash_one_format_lost() -> Broken:
    pieces = recorded.dataflash(DISTANCE)
    left = [piece for piece in pieces if not (piece.name == "FMT" and piece.data[5:8] == b"ATT")]
    lost = sum(len(piece.data) for piece in left if piece.name == "ATT")
    whole = _dataflash(left, "the definition of ATT is lost, but not its messages", lost=lost)
    kind = next(piece for piece in left if piece.name == "ATT").data[2]
    return replace(whole, note=f"messages of type {kind} begin at")


def dataflash_no_fix() -> Broken:
    def blind(piece: Piece) -> Piece:
        if piece.name == "GPS":
            piece = recorded.overwritten(piece, GPS_STATUS, "BIH", 1, 0, 0)
            return recorded.overwritten(piece, GPS_PLACE, "ii", 0, 0)
        if piece.name == "CAM":
            piece = recorded.overwritten(piece, CAM_WEEK - 4, "IH", 0, 0)
            return recorded.overwritten(piece, CAM_PLACE, "ii", 0, 0)
        return piece

    pieces = [blind(piece) for piece in recorded.dataflash(DISTANCE)]
    found = _dataflash(pieces, "the receiver never had a fix", note="no fix with a time is in the log")
    return replace(found, fixes=0)


def dataflash_another_vehicle() -> Broken:
    def moved(piece: Piece) -> Piece:
        if piece.name not in ("GPS", "CAM"):
            return piece
        week_at, place_at = (GPS_WEEK, GPS_PLACE) if piece.name == "GPS" else (CAM_WEEK, CAM_PLACE)
        (week,) = struct.unpack_from("<H", piece.data, week_at)
        latitude, longitude = struct.unpack_from("<ii", piece.data, place_at)
        piece = recorded.overwritten(piece, week_at, "H", week - 104)
        return recorded.overwritten(piece, place_at, "ii", latitude + 10_000_000, longitude - 20_000_000)

    pieces = [moved(piece) for piece in recorded.dataflash(DISTANCE)]
    first = next(piece for piece in pieces if piece.name == "GPS")
    (ms, week) = struct.unpack_from("<IH", first.data, GPS_MS)
    utc = datetime(1980, 1, 6, tzinfo=UTC) + timedelta(weeks=week, milliseconds=ms, seconds=-18)
    found = _dataflash(pieces, "whole, but of a flight two years before and elsewhere")
    return replace(found, first_utc=utc.isoformat()[:19])


def dataflash_zeros_at_the_end() -> Broken:
    whole = _dataflash(recorded.dataflash(DISTANCE), "space set aside and never written", lost=8000)
    return replace(whole, data=whole.data + bytes(8000), note="ends with 8000 zero bytes")


def dataflash_two_starts() -> Broken:
    """Of the second flight the fixes and exposures, enough for its own times."""
    second = [piece for piece in recorded.dataflash(WAYPOINT) if piece.name in ("GPS", "CAM", "ATT")]
    both = recorded.dataflash(DISTANCE) + second
    return _dataflash(both, "two flights joined into one file: boot times begin anew", note="was started 2 times")


def text_named() -> Broken:
    text = "Flight over the embankment: wind from the west, 3 m/s, nothing odd. Landed with 40 %.\n" * 20
    return Broken(data=text.encode(), defect="a pilot's notes under a log's name", error="this is text, no flight log")


def empty() -> Broken:
    return Broken(data=b"", defect="no byte in it", error="the file is empty")


def zeros() -> Broken:
    return Broken(data=bytes(20_000), defect="nothing was written but zeros", error="nothing but zeros")


def picture_named() -> Broken:
    data = b"\xff\xd8\xff\xe0\x00\x10JFIF\0\x01\x01\0\0\x01\0\x01\0\0" + bytes(range(1, 200)) * 5 + b"\xff\xd9"
    return Broken(data=data, defect="a picture under a log's name", error="this is a JPEG picture")


def _tlog(pieces: list[Piece], defect: str, *, lost: int = 0, note: str = "") -> Broken:
    exposures, fixes = count(pieces, "CAMERA_FEEDBACK"), count(pieces, "GPS_RAW_INT")
    return Broken(data=joined(pieces), defect=defect, exposures=exposures, fixes=fixes, lost_bytes=lost, note=note)


def tlog_flipped_bits() -> Broken:
    pieces = recorded.tlog(DISTANCE)
    spoilt = {nth(pieces, "CAMERA_FEEDBACK", n) for n in (3, 17)} | {nth(pieces, "GPS_RAW_INT", n) for n in (0, 50, 99)}
    spoilt |= {nth(pieces, "ATTITUDE", 20)}
    left = [piece for index, piece in enumerate(pieces) if index not in spoilt]
    lost = sum(len(pieces[index].data) for index in spoilt)
    found = _tlog(left, "six messages have a flipped bit, so that their checksums are wrong", lost=lost)
    flipped = [_flipped(piece) if index in spoilt else piece for index, piece in enumerate(pieces)]
    return replace(found, data=joined(flipped))


def _flipped(piece: Piece) -> Piece:
    (byte,) = struct.unpack_from("<B", piece.data, 8 + 10 + 5)
    return recorded.overwritten(piece, 8 + 10 + 5, "B", byte ^ 0x10)


def tlog_two_vehicles() -> Broken:
    first = recorded.tlog(DISTANCE)
    names = ("HEARTBEAT", "GPS_RAW_INT", "SYSTEM_TIME", "CAMERA_FEEDBACK")
    second = [recorded.of_system(piece, 2) for piece in recorded.tlog(WAYPOINT) if piece.name in names][:120]
    mixed = [piece for pair in zip(first, second, strict=False) for piece in pair] + first[len(second) :]
    assert 0 < count(second, "CAMERA_FEEDBACK") < count(first, "CAMERA_FEEDBACK")
    found = _tlog(first, "a second vehicle flew on the same link", note="vehicle 2 left out")
    return replace(found, data=joined(mixed))


def tlog_clock_jumps() -> Broken:
    pieces = recorded.tlog(DISTANCE)
    middle = len(pieces) // 2
    later = [*pieces[:middle], *(recorded.received_later(piece, 3600) for piece in pieces[middle:])]
    return _tlog(later, "the ground station's clock was set an hour ahead in flight", note="was set 1 times")


def tlog_reboot() -> Broken:
    both = recorded.tlog(DISTANCE) + recorded.tlog(WAYPOINT)
    return _tlog(both, "the vehicle was restarted between two flights", note="the vehicle was started 2 times")


def tlog_cut_in_a_frame() -> Broken:
    pieces = recorded.tlog(DISTANCE)
    last = nth(pieces, "CAMERA_FEEDBACK", 25)
    found = _tlog(pieces[:last], "the ground station broke down: it ends in the middle of a frame", lost=30)
    return replace(found, data=found.data + pieces[last].data[:30])


def tlog_without_a_vehicle() -> Broken:
    beat = frame("HEARTBEAT", (0, 6, 8, 0, 4, 3), Sender(system=255, component=190))
    data = b"".join(record(1_790_000_000_000_000 + n * 1_000_000, beat) for n in range(60))
    return Broken(data=data, defect="nothing but a ground station's own heartbeats", note="no vehicle in this log")


def tlog_of_a_vehicle_that_was_off() -> Broken:
    pieces = [piece for piece in recorded.tlog(DISTANCE) if piece.name in ("HEARTBEAT", "STATUSTEXT")]
    return _tlog(pieces, "no receiver and no camera ever spoke", note="no positions of a GNSS receiver")


def _ulog(pieces: list[Piece], defect: str, *, lost: int = 0, note: str = "") -> Broken:
    exposures, fixes = count(pieces, "camera_capture"), count(pieces, "vehicle_gps_position")
    return Broken(data=joined(pieces), defect=defect, exposures=exposures, fixes=fixes, lost_bytes=lost, note=note)


def ulog_header_lost() -> Broken:
    found = _ulog(recorded.ulog(), "the first 16 bytes, by which it is known, are zeros", lost=16)
    return replace(found, data=bytes(16) + found.data[16:])


def ulog_cut() -> Broken:
    pieces = recorded.ulog()
    last = nth(pieces, "camera_capture", 19)
    found = _ulog(pieces[:last], "the battery was pulled: it ends in the middle of a message", lost=25)
    return replace(found, data=found.data + pieces[last].data[:25])


def ulog_gap() -> Broken:
    """From the middle of a message to the begin of another all is missing: what is left of the first is lost."""
    pieces = recorded.ulog()
    first, last = nth(pieces, "vehicle_gps_position", 40), nth(pieces, "camera_capture", 15)
    left = [*pieces[:first], *pieces[last:]]
    found = _ulog(left, "a piece was dropped in the middle, for the card was too slow", lost=12)
    at = begin_of(pieces, first)
    return replace(found, data=found.data[:at] + pieces[first].data[:12] + found.data[at:])


def _utc(tow_ms: int, leap_s: int = 18, week: int = gnss.WEEK) -> datetime:
    return datetime(1980, 1, 6, tzinfo=UTC) + timedelta(weeks=week, milliseconds=tow_ms, seconds=-leap_s)


def _pvt(second: int, leap_s: int = 18, week: int = gnss.WEEK, valid: int = 7) -> bytes:
    utc = _utc(TOW_MS + second * 1000, leap_s, week)
    fields = (utc.year, utc.month, utc.day, utc.hour, utc.minute, utc.second)
    return gnss.pvt(TOW_MS + second * 1000, fields, valid=valid, lat=356_000_000 + second * 100)


FIRST_UTC = _utc(TOW_MS).isoformat()[:19]


def ubx_bad_checksums() -> Broken:
    epochs = [_pvt(second) for second in range(60)]
    spoilt = range(4, 60, 7)
    for second in spoilt:
        epochs[second] = epochs[second][:40] + bytes([epochs[second][40] ^ 1]) + epochs[second][41:]
    lost = sum(len(epochs[second]) for second in spoilt)
    defect = "bits were flipped on a bad cable: every seventh frame has a wrong checksum"
    fixes = 60 - len(spoilt)
    return Broken(data=b"".join(epochs), defect=defect, fixes=fixes, lost_bytes=lost, first_utc=FIRST_UTC)


def ubx_week_roll_over() -> Broken:
    data = b"".join(_pvt(second, week=gnss.WEEK - 1024) for second in range(60))
    defect = "old firmware: dates are 1024 weeks too early"
    return Broken(data=data, defect=defect, fixes=60, note="1024 weeks too early", first_utc=FIRST_UTC)


def ubx_no_leap_seconds() -> Broken:
    """Without an almanac the receiver's UTC is 2 s ahead; its time of week is right."""
    told = gnss.timels(TOW_MS, source=0, leap=16, valid=0)
    data = told + b"".join(_pvt(second, leap_s=16, valid=3) for second in range(60))
    defect = "no almanac yet: the receiver takes 16 leap seconds for granted, there are 18"
    return Broken(data=data, defect=defect, fixes=60, note="tells 16 leap seconds", first_utc=FIRST_UTC)


def ubx_missed_marks() -> Broken:
    parts, missed = list[bytes](), (10, 20)
    for second in range(60):
        parts.append(_pvt(second))
        number = second // 2
        if second % 2 == 0 and number not in missed:
            parts.append(gnss.tm2(number + 100, (gnss.WEEK, TOW_MS + second * 1000 + 250, 125_000)))
    note = "2 time marks are missing"
    return Broken(
        data=b"".join(parts),
        defect="two of 30 pictures are not told, but counted, by the receiver",
        exposures=28,
        fixes=60,
        note=note,
        first_utc=FIRST_UTC,
    )


def ubx_no_fix() -> Broken:
    data = b"".join(gnss.pvt(second * 1000, (1980, 1, 6, 0, 0, 0), valid=0, fix=(0, 0)) for second in range(30))
    return Broken(data=data, defect="under a roof: no fix, and the date of 1980")


def nmea_cut_lines() -> Broken:
    """GGA alone is cut in some epochs (RMC still tells where), both in others."""
    without_gga, without_both = range(3, 60, 10), range(5, 60, 20)
    parts, lost = list[bytes](), 0
    for second in range(60):
        for kind, line in enumerate(nmea_epoch(second)):
            cut = second in without_both or (kind == 0 and second in without_gga)
            parts.append(line[:25] if cut else line)
            lost += 25 if cut else 0
    return Broken(
        data=b"".join(parts),
        defect="the serial line lost bytes: sentences lack their ends",
        fixes=60 - len(without_both),
        lost_bytes=lost,
        first_utc=FIRST_UTC,
    )


def nmea_epoch(second: int) -> tuple[bytes, bytes]:
    utc = _utc(TOW_MS + second * 1000)
    clock, day = utc.strftime("%H%M%S.00"), utc.strftime("%d%m%y")
    place = f"3536.{second:04d}0,N,13940.12000,E"
    gga = gnss.nmea(f"GPGGA,{clock},{place},1,09,0.90,36.2,M,39.3,M,,")
    return gga, gnss.nmea(f"GPRMC,{clock},A,{place},2.10,10.00,{day},,,A")


def places(number: int = 33) -> list[tuple[float, float]]:
    return [(round(35.8 + index * 1e-4, 6), round(139.65 + index % 3 * 1e-4, 6)) for index in range(number)]


def _kml(marks: list[str], prologue: str = "") -> bytes:
    body = "\n".join(marks)
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    return (
        f'{head}{prologue}<kml xmlns="http://www.opengis.net/kml/2.2"><Document>\n{body}\n</Document></kml>\n'.encode()
    )


def mark(name: str, first: float, second: float) -> str:
    point = f"<Point><altitudeMode>absolute</altitudeMode><coordinates>{first},{second},60.5</coordinates></Point>"
    return f"<Placemark><name>{name}</name>{point}</Placemark>"


def no_times() -> Broken:
    marks = [mark(f"W{n}", longitude, latitude) for n, (latitude, longitude) in enumerate(places(), start=1)]
    return Broken(data=_kml(marks), defect="waypoints without a time, as the Falcon 8 lists them", exposures=33)


def latitude_first() -> Broken:
    marks = [mark(f"W{n}", latitude, longitude) for n, (latitude, longitude) in enumerate(places(), start=1)]
    return Broken(data=_kml(marks), defect="latitude before longitude: 139 degrees north", error="is a place")


def entity_bomb() -> Broken:
    entities = "".join(f'<!ENTITY e{n} "{f"&e{n - 1};" * 10}">' for n in range(1, 12))
    prologue = f'<!DOCTYPE kml [<!ENTITY e0 "aaaaaaaaaa">{entities}]>\n'
    data = _kml([mark("&e11;", 139.65, 35.8)], prologue)
    return Broken(data=data, defect="entities that would unfold to a terabyte", error="document type declaration")


def zip_bomb() -> Broken:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_BZIP2) as archive:
        entry = zipfile.ZipInfo("doc.kml", date_time=(2026, 1, 1, 0, 0, 0))
        entry.compress_type = zipfile.ZIP_BZIP2
        with archive.open(entry, "w", force_zip64=True) as document:
            document.write(b'<?xml version="1.0"?><kml><Document><Placemark><name>')
            for _ in range(300):
                document.write(b"W" * 1024 * 1024)
            document.write(b"</name></Placemark></Document></kml>")
    return Broken(data=stream.getvalue(), defect="a few kilobytes that unpack to 300 MB", error="that is no flight")


def archive_without_kml() -> Broken:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo("photo.txt", date_time=(2026, 1, 1, 0, 0, 0)), "no flight")
    return Broken(data=stream.getvalue(), defect="a zip archive of other things", error="this is a zip archive")


GPX_HEAD = '<?xml version="1.0"?>\n<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>\n'


def gpx_points() -> list[str]:
    points = []
    for second, (latitude, longitude) in enumerate(places(40)):
        time = _utc(TOW_MS + second * 1000).strftime("%Y-%m-%dT%H:%M:%SZ")
        points.append(f'<trkpt lat="{latitude}" lon="{longitude}"><ele>36.5</ele><time>{time}</time></trkpt>\n')
    return points


def gpx_cut() -> Broken:
    points = gpx_points()
    data = (GPX_HEAD + "".join(points[:30]) + points[30][:50]).encode()
    return Broken(data=data, defect="cut off in a point", fixes=30, lost_bytes=50, first_utc=FIRST_UTC)


def srt_parts() -> list[str]:
    parts = []
    for number, (latitude, longitude) in enumerate(places(25), start=1):
        begin, end = (f"00:00:{number + step:02d},000" for step in (0, 1))
        place = f"[latitude: {latitude}] [longitude: {longitude}] [rel_alt: 15.100 abs_alt: 51.200]"
        text = f"FrameCnt: {number}\n2026-11-22 13:00:{number:02d}.000\n[iso: 100] [fnum: 2.8] {place}\n\n"
        parts.append(f"{number}\n{begin} --> {end}\n{text}")
    return parts


def srt_cut() -> Broken:
    parts = srt_parts()
    cut = parts[20][: parts[20].index("[longitude")]
    data = ("".join(parts[:20]) + cut).encode()
    return Broken(data=data, defect="cut off between latitude and longitude", fixes=20, lost_bytes=len(cut))


def mrk_lines() -> list[str]:
    lines = []
    for number, (latitude, longitude) in enumerate(places(20), start=1):
        second, place = 100_018 + 2 * number, f"{latitude:.8f},Lat\t{longitude:.8f},Lon\t75.500,Ellh"
        lines.append(f"{number}\t{second}.250000\t[2400]\t-40,N\t0,E\t86,V\t{place}\t0.010, 0.011, 0.025\t50,Q\n")
    return lines


def mrk_cut() -> Broken:
    lines = mrk_lines()
    data = ("".join(lines[:14]) + lines[14][:60]).encode()
    utc = _utc(100_020_250).isoformat()[:19]
    defect = "the card was full: the last line is not whole"
    return Broken(data=data, defect=defect, exposures=14, fixes=14, lost_bytes=60, first_utc=utc)


def csv_without_mapping() -> Broken:
    rows = [f"{n},{latitude},{longitude},36.5" for n, (latitude, longitude) in enumerate(places(20), start=1)]
    data = "\n".join(["Photo,Northing,Easting,Alt", *rows, ""]).encode()
    return Broken(data=data, defect="nothing says what its columns are", error="csv_without_mapping.csv.toml")


RECIPES: dict[str, Callable[[], Broken]] = {
    "archive_without_kml.kmz": archive_without_kml,
    "csv_without_mapping.csv": csv_without_mapping,
    "dataflash_another_vehicle.BIN": dataflash_another_vehicle,
    "dataflash_block_of_zeros.BIN": dataflash_block_of_zeros,
    "dataflash_cut_in_a_message.BIN": dataflash_cut_in_a_message,
    "dataflash_formats_lost.BIN": dataflash_formats_lost,
    "dataflash_no_fix.BIN": dataflash_no_fix,
    "dataflash_one_format_lost.BIN": dataflash_one_format_lost,
    "dataflash_two_starts.BIN": dataflash_two_starts,
    "dataflash_zeros_at_the_end.BIN": dataflash_zeros_at_the_end,
    "empty.BIN": empty,
    "entity_bomb.kml": entity_bomb,
    "gpx_cut.gpx": gpx_cut,
    "latitude_first.kml": latitude_first,
    "mrk_cut.MRK": mrk_cut,
    "nmea_cut_lines.nmea": nmea_cut_lines,
    "no_times.kml": no_times,
    "picture_named.tlog": picture_named,
    "srt_cut.srt": srt_cut,
    "text_named.BIN": text_named,
    "tlog_clock_jumps.tlog": tlog_clock_jumps,
    "tlog_cut_in_a_frame.tlog": tlog_cut_in_a_frame,
    "tlog_flipped_bits.tlog": tlog_flipped_bits,
    "tlog_of_a_vehicle_that_was_off.tlog": tlog_of_a_vehicle_that_was_off,
    "tlog_reboot.tlog": tlog_reboot,
    "tlog_two_vehicles.tlog": tlog_two_vehicles,
    "tlog_without_a_vehicle.tlog": tlog_without_a_vehicle,
    "ubx_bad_checksums.ubx": ubx_bad_checksums,
    "ubx_missed_marks.ubx": ubx_missed_marks,
    "ubx_no_fix.ubx": ubx_no_fix,
    "ubx_no_leap_seconds.ubx": ubx_no_leap_seconds,
    "ubx_week_roll_over.ubx": ubx_week_roll_over,
    "ulog_cut.ulg": ulog_cut,
    "ulog_gap.ulg": ulog_gap,
    "ulog_header_lost.ulg": ulog_header_lost,
    "zeros.BIN": zeros,
    "zip_bomb.kmz": zip_bomb,
}

_ABOUT = '''# Small logs, each broken in the one way that its name says.
origin = """
Made by tests/sim_logs/broken_recipes.py: messages of the flights recorded beside (thinned, each as it was, byte for
byte), and of receivers and lists encoded for the purpose; then cut, overwritten or mixed as each recipe says.
"""
truth = """
What is expected of each file follows from what was broken, not from what a program reads: either words of the error,
or the exposures, the fixes (those without a position not counted), the bytes that belong to no intact message, words of
a note, and the first known time. Both the files and this page come from the recipes; a test holds them together.
"""
'''


def about(files: dict[str, Broken]) -> str:
    """Return ABOUT.toml."""
    lines = [_ABOUT]
    for name, broken in files.items():
        lines += ["[[log]]", f"file = {json.dumps(name)}", f"defect = {json.dumps(broken.defect)}"]
        if broken.error:
            lines.append(f"error = {json.dumps(broken.error)}")
        else:
            lines += [f"{key} = {getattr(broken, key)}" for key in ("exposures", "fixes", "lost_bytes")]
            words = {"note": broken.note, "first_utc": broken.first_utc}
            lines += [f"{key} = {json.dumps(text)}" for key, text in words.items() if text]
        lines.append("")
    lines.append("[sha256]")
    lines += [f'"{name}" = "{hashlib.sha256(broken.data).hexdigest()}"' for name, broken in files.items()]
    return "\n".join(lines) + "\n"


def write(folder: Path) -> None:
    """Write all files and their ABOUT.toml."""
    folder.mkdir(exist_ok=True)
    files = {name: make() for name, make in RECIPES.items()}
    for name, broken in files.items():
        (folder / name).write_bytes(broken.data)
    (folder / "ABOUT.toml").write_text(about(files), encoding="utf-8")


if __name__ == "__main__":
    write(FOLDER)
