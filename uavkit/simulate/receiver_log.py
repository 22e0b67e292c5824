"""The recording of a u-blox receiver on board of a simulated flight: fixes five times a second, marks of the shutter.

The camera's flash contact is wired to the receiver's EXTINT pin, so each exposure is a TIM-TM2 message. Formats: u-blox
M8 and F9 interface descriptions (NAV-PVT, NAV-HPPOSLLH, TIM-TM2). Antenna and projection centre are the same place.
"""

import struct
from pathlib import Path

import numpy as np

from uavkit.core.arrays import Array
from uavkit.core.frames import geoid_undulation_m
from uavkit.core.gpstime import WEEK_NS, utc_from_gps_time_ns
from uavkit.formats.atomic import atomic_path
from uavkit.simulate.flight import Flight
from uavkit.simulate.options import SimulationOptions
from uavkit.simulate.positions import RTK_SIGMA_M
from uavkit.simulate.site import gps_time_ns, site_frame

INTERVAL_NS = 200_000_000
FEEDBACK_LATENCY_S = 0.0008
"""From the shutter to the time stamp of its flash contact."""
VELOCITY_SIGMA_M_S = 0.05
MARK_SIGMA_NS = 30


def write_receiver_log(path: Path, flight: Flight, shift_m: Array, options: SimulationOptions) -> None:
    """Write the recording; ``shift_m`` (3,) is the common error of its positions."""
    rng = np.random.default_rng([options.seed, 14])
    sigma_m = max(options.gnss_sigma_m, 0.001)
    times_ns = _epochs_ns(flight)
    times_s: Array = np.asarray((times_ns - gps_time_ns(0.0)) * 1e-9, dtype=np.float64)
    measured_m = flight.positions_m(times_s) + shift_m + rng.normal(0.0, sigma_m, (len(times_s), 3))
    velocity = (flight.positions_m(times_s + 0.05) - flight.positions_m(times_s - 0.05)) / 0.1
    velocity += rng.normal(0.0, VELOCITY_SIGMA_M_S, velocity.shape)
    messages: list[tuple[int, bytes]] = []
    for time_ns, place, speed in zip(
        times_ns.tolist(), site_frame().geographic_from_enu(measured_m), velocity, strict=True
    ):
        messages.append((time_ns, _fix(time_ns, place, speed, sigma_m)))
    for number, time_s in enumerate(flight.exposure_s.tolist(), start=1):
        mark_ns = gps_time_ns(time_s + FEEDBACK_LATENCY_S) + round(float(rng.normal(0.0, MARK_SIGMA_NS)))
        messages.append((mark_ns, _mark(number, mark_ns)))
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"".join(message for _, message in sorted(messages)))


def _epochs_ns(flight: Flight) -> "np.typing.NDArray[np.int64]":
    """Return the receiver's epochs, on whole multiples of their interval, over the flight."""
    begin, end = gps_time_ns(0.1), gps_time_ns(len(flight.states.state) * flight.field_interval_s - 0.1)
    return np.arange(-(-begin // INTERVAL_NS), end // INTERVAL_NS + 1, dtype=np.int64) * INTERVAL_NS


def _frame(kind: tuple[int, int], payload: bytes) -> bytes:
    """Return a UBX frame with its 8-bit Fletcher checksum."""
    body = bytes(kind) + struct.pack("<H", len(payload)) + payload
    a = b = 0
    for byte in body:
        a = (a + byte) & 0xFF
        b = (b + a) & 0xFF
    return b"\xb5\x62" + body + bytes((a, b))


def _fix(time_ns: int, place: Array, velocity_m_s: Array, sigma_m: float) -> bytes:
    """Return NAV-PVT and NAV-HPPOSLLH of an epoch; its stated accuracy is that of both horizontal axes together."""
    latitude, longitude, height = place.tolist()
    above_geoid = height - float(geoid_undulation_m(np.array(latitude), np.array(longitude)))
    tow_ms = time_ns % WEEK_NS // 1_000_000
    horizontal, vertical = sigma_m * float(np.sqrt(2.0)), sigma_m
    east, north, up = (round(1000.0 * value) for value in velocity_m_s.tolist())
    heading = round(float(np.degrees(np.arctan2(east, north)) % 360.0) * 1e5)
    utc = utc_from_gps_time_ns(time_ns)
    coarse, fine = zip(*(_parts(value) for value in (longitude * 1e7, latitude * 1e7)), strict=True)
    heights, height_rest = zip(*(_parts(value, 0.1) for value in (height * 1e3, above_geoid * 1e3)), strict=True)
    flags = 0x01 | (0x80 if sigma_m < RTK_SIGMA_M else 0)
    pvt = struct.pack(
        "<IHBBBBBBIiBBBBiiiiIIiiiiiIIHH4xihH",
        *(tow_ms, utc.year, utc.month, utc.day, utc.hour, utc.minute, utc.second, 0x07, 25, utc.microsecond * 1000),
        *(3, flags, 0, 9, *coarse, *heights, round(1000 * horizontal), round(1000 * vertical)),
        *(north, east, -up, round(float(np.hypot(east, north))), heading, round(1000 * VELOCITY_SIGMA_M_S)),
        *(500_000, 180, 0, 0, 0, 0),
    )
    precise = struct.pack(
        "<B2xBIiiiibbbbII",
        *(0, 0, tow_ms, *coarse, *heights, *fine, *height_rest, round(1e4 * horizontal), round(1e4 * vertical)),
    )
    return _frame((0x01, 0x07), pvt) + _frame((0x01, 0x14), precise)


def _parts(value: float, unit: float = 0.01) -> tuple[int, int]:
    """Return the whole part of a value, and the rest in hundredths (or ``unit``)."""
    whole = round(value)
    return whole, round((value - whole) / unit)


def _mark(number: int, time_ns: int) -> bytes:
    """Return TIM-TM2 of a rising edge; the pulse ends 5 ms later."""
    edges = []
    for edge_ns in (time_ns, time_ns + 5_000_000):
        week, tow_ns = divmod(edge_ns, WEEK_NS)
        edges.append((week, *divmod(tow_ns, 1_000_000)))
    (rise_week, rise_ms, rise_ns), (fall_week, fall_ms, fall_ns) = edges
    flags = 0x80 | 0x40 | (1 << 3) | 0x04 | 0x02  # new rising and falling edge, time valid, GNSS time base, running
    payload = struct.pack(
        "<BBHHHIIIII", *(0, flags, number, rise_week, fall_week, rise_ms, rise_ns, fall_ms, fall_ns, MARK_SIGMA_NS)
    )
    return _frame((0x0D, 0x03), payload)
