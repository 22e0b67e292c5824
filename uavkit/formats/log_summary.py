"""What is in a flight log, for people (lines) and for programs (plain data for JSON)."""

from typing import Any

import numpy as np

from uavkit.core.arrays import Indices
from uavkit.core.flight_log import ExposureKind, ExposureTable, FixTable, FixType, FlightLog
from uavkit.core.gpstime import NO_TIME, utc_from_gps_time_ns

MOST_SPANS_TOLD = 5
MOST_KINDS_TOLD = 40
LONG_GAP_S, LONG_GAP_STEPS = 2.0, 10.0
"""Longer times without a fix, and so many usual intervals, are told."""


def log_summary(log: FlightLog) -> dict[str, Any]:
    """Return the contents of a log as plain data; times are UTC (ISO 8601), None where unknown."""
    begin, end = _span(log)
    return {
        "file": log.source,
        "kind": log.kind.value,
        "vehicle": log.vehicle,
        "begin_utc": _utc(begin),
        "end_utc": _utc(end),
        "duration_s": None if begin is None or end is None else round((end - begin) * 1e-9, 3),
        "clock": _clock(log),
        "fixes": _fixes(log.fix_table),
        "autopilot_positions": _fixes(log.estimate_table),
        "attitudes": len(log.attitude_table),
        "exposures": _exposures(log.exposure_table),
        "parameters": len(log.parameters),
        "texts": list(log.texts),
        "messages": dict(sorted(log.message_counts.items())),
        "damage": {
            "lost_bytes": log.damage.lost_bytes,
            "places": log.damage.span_count,
            "spans": [{"offset": span.offset, "length": span.length, "why": span.why} for span in log.damage.spans],
        },
        "notes": [*log.notes, *_missing(log)],
    }


def _missing(log: FlightLog) -> list[str]:
    """Return what seems to be cut out of a log: numbers of exposures, and times without fixes."""
    notes = []
    numbers = log.exposure_table.sequence[log.exposure_table.sequence >= 0]
    if len(numbers) > 1:
        absent = np.setdiff1d(np.arange(numbers.min(), numbers.max()), numbers)
        if 0 < len(absent) <= len(numbers):
            shown = ", ".join(map(str, absent[:MOST_SPANS_TOLD].tolist())) + (
                ", ..." if len(absent) > MOST_SPANS_TOLD else ""
            )
            notes.append(f"{len(absent)} exposures are missing by their numbers: {shown}")
    table = log.fix_table
    times = np.unique(_known(table.when.gps_ns[table.receiver == table.receiver.min(initial=255)]))
    steps_s = np.diff(times) * 1e-9
    if len(steps_s) > 10:
        longest = int(np.argmax(steps_s))
        if steps_s[longest] > max(LONG_GAP_S, LONG_GAP_STEPS * float(np.median(steps_s))):
            begin, end = _utc(int(times[longest])), _utc(int(times[longest + 1]))
            notes.append(f"no fixes for {steps_s[longest]:.1f} s, {begin} to {end}")
    return notes


def _known(when_ns: Indices) -> Indices:
    return np.asarray(when_ns[when_ns != NO_TIME])


def _span(log: FlightLog) -> tuple[int | None, int | None]:
    tables = (log.fix_table, log.estimate_table, log.attitude_table, log.exposure_table)
    known = np.concatenate([_known(table.when.gps_ns) for table in tables])
    return (int(known.min()), int(known.max())) if len(known) else (None, None)


def _utc(gps_ns: int | None) -> str | None:
    if gps_ns is None or gps_ns < 0:
        return None
    return utc_from_gps_time_ns(gps_ns).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _clock(log: FlightLog) -> dict[str, Any] | None:
    if log.clock is None:
        return None
    return {
        "segments": len(log.clock.segments),
        "pairs": sum(segment.samples for segment in log.clock.segments),
        "rejected": log.clock.rejected,
        "drift_ppm": round(log.clock.drift_ppm, 2),
        "residual_s": round(log.clock.residual_s, 6),
    }


def _fixes(table: FixTable) -> dict[str, Any]:
    types = {FixType(int(kind)).name.lower(): int(np.sum(table.fix_type == kind)) for kind in np.unique(table.fix_type)}
    times = np.sort(_known(table.when.gps_ns[table.receiver == table.receiver.min(initial=255)]))
    steps = np.diff(times)[np.diff(times) > 0]
    return {
        "count": len(table),
        "receivers": len(np.unique(table.receiver)),
        "types": types,
        "interval_s": round(float(np.median(steps)) * 1e-9, 3) if len(steps) else None,
        "sigma_horizontal_m": _median(table.sigma_horizontal_m),
        "sigma_vertical_m": _median(table.sigma_vertical_m),
        "heights": [
            name
            for name, column in (
                ("ellipsoid", table.height_ellipsoid_m),
                ("geoid", table.height_geoid_m),
                ("above take-off", table.height_above_home_m),
            )
            if np.any(np.isfinite(column))
        ],
    }


def _median(column: "np.typing.NDArray[np.float64]") -> float | None:
    known = column[np.isfinite(column)]
    return round(float(np.median(known)), 4) if len(known) else None


def _exposures(table: ExposureTable) -> dict[str, Any]:
    times = _known(table.when.gps_ns)
    return {
        "count": len(table),
        "kinds": {
            ExposureKind(int(kind)).name.lower(): int(np.sum(table.kind == kind)) for kind in np.unique(table.kind)
        },
        "first_utc": _utc(int(times.min())) if len(times) else None,
        "last_utc": _utc(int(times.max())) if len(times) else None,
        "without_time": len(table) - len(times),
        "with_position": int(np.sum(np.isfinite(table.latitude_deg))),
    }


def summary_lines(log: FlightLog) -> list[str]:
    """Return the contents of a log in lines."""
    told = log_summary(log)
    lines = [f"{told['file']}: {told['kind']}" + (f", {log.vehicle}" if log.vehicle else "")]
    if told["begin_utc"]:
        lines.append(f"time      {told['begin_utc']} to {told['end_utc']}, {_duration(told['duration_s'])}")
    else:
        lines.append("time      nothing in it tells GPS time")
    if told["clock"]:
        clock = told["clock"]
        pieces = "" if clock["segments"] == 1 else f" in {clock['segments']} pieces"
        lines.append(
            f"clock     boot clock fitted to GPS time by {clock['pairs']} pairs{pieces}: drift "
            f"{clock['drift_ppm']:+.1f} ppm, residual {1e3 * clock['residual_s']:.1f} ms"
        )
    lines += [_fix_line("positions", told["fixes"]), _fix_line("autopilot", told["autopilot_positions"])]
    lines.append(f"attitudes {told['attitudes']}")
    lines.append(_exposure_line(told["exposures"]))
    lines.append(_damage_line(told["damage"]))
    spans = told["damage"]["spans"]
    lines += [f"          at byte {s['offset']}: {s['length']} bytes, {s['why']}" for s in spans[:MOST_SPANS_TOLD]]
    if told["damage"]["places"] > MOST_SPANS_TOLD:
        lines.append(f"          and {told['damage']['places'] - MOST_SPANS_TOLD} more places")
    lines += _message_lines(told["messages"])
    return [line for line in lines if line] + [f"note: {note}" for note in told["notes"]]


def _duration(seconds: float) -> str:
    minutes, rest = divmod(seconds, 60.0)
    return f"{minutes:.0f} min {rest:.1f} s"


def _fix_line(label: str, told: dict[str, Any]) -> str:
    if not told["count"]:
        return "positions none" if label == "positions" else ""
    parts = [f"{label} {told['count']}"]
    if told["receivers"] > 1:
        parts.append(f"of {told['receivers']} receivers")
    if told["interval_s"]:
        parts.append(f"every {told['interval_s']:g} s")
    kinds = ", ".join(f"{count} {kind.replace('_', ' ')}" for kind, count in told["types"].items() if kind != "unknown")
    if kinds:
        parts.append(f"({kinds})")
    if told["sigma_horizontal_m"] is not None:
        parts.append(f"sigma {told['sigma_horizontal_m']:g} m")
    heights = " and ".join(told["heights"]) or "none"
    return " ".join(parts) + f", heights: {heights}"


def _exposure_line(told: dict[str, Any]) -> str:
    if not told["count"]:
        return "exposures none"
    kinds = ", ".join(f"{count} {kind}" for kind, count in told["kinds"].items())
    span = f", {told['first_utc']} to {told['last_utc']}" if told["first_utc"] else ""
    without = f", {told['without_time']} without a time" if told["without_time"] else ""
    return f"exposures {told['count']} ({kinds}){span}{without}"


def _damage_line(told: dict[str, Any]) -> str:
    if not told["lost_bytes"]:
        return "damage    none"
    places = "place" if told["places"] == 1 else "places"
    return f"damage    {told['lost_bytes']} bytes lost in {told['places']} {places}"


def _message_lines(counts: dict[str, int]) -> list[str]:
    most = sorted(counts.items(), key=lambda entry: (-entry[1], entry[0]))
    shown = ", ".join(f"{name} {count}" for name, count in most[:MOST_KINDS_TOLD])
    rest = f", and {len(most) - MOST_KINDS_TOLD} other kinds" if len(most) > MOST_KINDS_TOLD else ""
    return [f"messages  {sum(counts.values())}: {shown}{rest}"] if counts else []
