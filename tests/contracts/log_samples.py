"""An intact log of each kind: recorded flights, and what the readers' own recipes make."""

import struct
from collections.abc import Callable

from tests.sim_logs import broken_recipes as recipes
from tests.sim_logs import recorded_pieces as recorded
from uavkit.core.flight_log import LogKind

TIME = "<when>2026-01-05T03:46:{:02d}Z</when>"


def _text_dataflash() -> bytes:
    """Return receiver, parameters and exposures of a recorded flight as a ground station writes them."""
    names = ("GPS", "CAM", "PARM")
    lines = ["FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns"]
    formats: dict[str, str] = {}
    for piece in recorded.dataflash("sitl_distance_trigger"):
        if piece.name == "FMT":
            kind, length, *texts = struct.unpack("<3xBB4s16s64s", piece.data)
            name, layout, columns = (text.rstrip(b"\0").decode() for text in texts)
            formats[name] = layout
            if name in names:
                lines.append(f"FMT, {kind}, {length}, {name}, {layout}, {columns}")
        elif piece.name in names:
            lines.append(", ".join([piece.name, *_values(formats[piece.name], piece.data[3:])]))
    return ("\n".join(lines) + "\n").encode()


def _values(layout: str, payload: bytes) -> list[str]:
    codes = {"c": "h", "C": "H", "e": "i", "E": "I", "L": "i", "N": "16s"}
    texts = []
    for character, value in zip(
        layout, struct.unpack("<" + "".join(codes.get(c, c) for c in layout), payload), strict=True
    ):
        if isinstance(value, bytes):
            texts.append(value.rstrip(b"\0").decode())
        elif character == "L":
            texts.append(f"{value * 1e-7:.7f}")
        else:
            texts.append(f"{value * 0.01:.2f}" if character in "cCeE" else f"{value}")
    return texts


def _nmea() -> bytes:
    return b"".join(line for second in range(60) for line in recipes.nmea_epoch(second))


def _track_kml() -> bytes:
    places = recipes.places()
    times = "".join(TIME.format(second) for second in range(len(places)))
    coords = "".join(f"<gx:coord>{longitude} {latitude} 60.5</gx:coord>" for latitude, longitude in places)
    mode = "<altitudeMode>absolute</altitudeMode>"
    marks = [recipes.mark(f"W{n}", longitude, latitude) for n, (latitude, longitude) in enumerate(places)]
    track = f"<Placemark><gx:Track>{mode}{times}{coords}</gx:Track></Placemark>"
    head = '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"><Document>\n'
    return (head + "\n".join([*marks, track]) + "\n</Document></kml>\n").encode()


def _gpx() -> bytes:
    whole = recipes.gpx_points()
    marks = "".join(f'<wpt lat="{latitude}" lon="{longitude}"/>\n' for latitude, longitude in recipes.places(5))
    return (recipes.GPX_HEAD.replace("<trk>", marks + "<trk>") + "".join(whole) + "</trkseg></trk></gpx>\n").encode()


def _csv() -> bytes:
    rows = [
        f"{1_450_000_000 + n}000000000,{latitude},{longitude},75.5,0.02,trigger,{n}"
        for n, (latitude, longitude) in enumerate(recipes.places(20))
    ]
    header = "gps_time_ns,latitude_deg,longitude_deg,height_ellipsoid_m,sigma_s,kind,sequence"
    return "\n".join(["# uavkit flight log: exposures", header, *rows, ""]).encode()


SAMPLES: dict[LogKind, Callable[[], bytes]] = {
    LogKind.DATAFLASH: lambda: recorded.joined(recorded.dataflash("sitl_distance_trigger")),
    LogKind.DATAFLASH_TEXT: _text_dataflash,
    LogKind.TLOG: lambda: recorded.joined(recorded.tlog("sitl_waypoint_trigger")),
    LogKind.ULOG: lambda: recorded.joined(recorded.ulog()),
    LogKind.UBX: lambda: recipes.ubx_missed_marks().data,
    LogKind.NMEA: _nmea,
    LogKind.KML: _track_kml,
    LogKind.GPX: _gpx,
    LogKind.DJI_SRT: lambda: "".join(recipes.srt_parts()).encode(),
    LogKind.DJI_MRK: lambda: "".join(recipes.mrk_lines()).encode(),
    LogKind.CSV: _csv,
}
EXPOSURES = {
    LogKind.DATAFLASH: 31, LogKind.DATAFLASH_TEXT: 31, LogKind.TLOG: 33, LogKind.ULOG: 31, LogKind.UBX: 28,
    LogKind.NMEA: 0, LogKind.KML: 33, LogKind.GPX: 5, LogKind.DJI_SRT: 0, LogKind.DJI_MRK: 20, LogKind.CSV: 20,
}  # fmt: skip
