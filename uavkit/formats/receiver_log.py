"""The log of a GNSS receiver: u-blox frames, NMEA sentences and RTCM frames in one stream."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from uavkit.core.errors import InputError
from uavkit.core.flight_log import FixTable, FixType, FlightLog, LogKind, no_attitudes, no_exposures, no_fixes
from uavkit.core.gpstime import NO_TIME
from uavkit.core.progress import Progress
from uavkit.formats.log_bytes import DamageTally, opened
from uavkit.formats.nmea_epochs import Sentences
from uavkit.formats.receiver_stream import NMEA, UBX, Batch, batches, name_of_rtcm, name_of_sentence
from uavkit.formats.ubx_epochs import Messages, fix_types, joined_epochs
from uavkit.formats.ubx_marks import ubx_marks
from uavkit.formats.ubx_messages import DECODED, MON_VER, NAMES, name_of_frame
from uavkit.formats.ubx_positions import ubx_fixes
from uavkit.formats.ubx_times import epoch_times

_INFORMATION = (0x0400, 0x0401, 0x0402)
_MOST_TEXTS = 1000
_RAW = ("RXM-RAW", "RXM-RAWX")


class _Collector:
    """What is gathered from the batches of a stream."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.frames = 0
        self.sentences = Sentences()
        self.texts: list[str] = []
        self.vehicle = ""
        self._parts: dict[str, list[Messages]] = {}

    def add(self, batch: Batch) -> None:
        for kind, code, count in batch.named():
            name = name_of_frame if kind == UBX else name_of_sentence if kind == NMEA else name_of_rtcm
            self.counts[name(code)] += count
            self.frames += count if kind == UBX else 0
            if kind == UBX and code in DECODED:
                self._decode(batch, code)
        self._read_texts(batch)
        self.sentences.add(batch)

    def _decode(self, batch: Batch, code: int) -> None:
        dtype = DECODED[code]
        payloads, lengths, offsets = batch.frames(code, dtype.itemsize)
        rows = np.ascontiguousarray(payloads).view(dtype)[:, 0] if len(payloads) else np.zeros(0, dtype=dtype)
        part = Messages(rows=rows, lengths=lengths, offsets=offsets)
        self._parts.setdefault(NAMES[code], []).append(part)

    def _read_texts(self, batch: Batch) -> None:
        wanted = (batch.kinds == UBX) & np.isin(batch.codes, (*_INFORMATION, MON_VER))
        for row in np.flatnonzero(wanted).tolist():
            begin, length = batch.places[row].tolist()
            payload = batch.block[begin + 6 : begin + length - 2].tobytes()
            if batch.codes[row] == MON_VER:
                self.vehicle = _version(payload) or self.vehicle
            elif len(self.texts) < _MOST_TEXTS:
                self.texts.append(_text(payload))

    def messages(self) -> dict[str, Messages]:
        """Return the decoded messages by name, kinds without a row left out; they are no longer kept here."""
        result = {}
        while self._parts:
            name, parts = self._parts.popitem()
            joined = Messages(
                rows=np.concatenate([part.rows for part in parts]),
                lengths=np.concatenate([part.lengths for part in parts]),
                offsets=np.concatenate([part.offsets for part in parts]),
            )
            if len(joined.rows):
                result[name] = joined
        return result


def _text(payload: bytes) -> str:
    return payload.split(b"\0")[0].decode("ascii", "replace").strip()


def _version(payload: bytes) -> str:
    """Return hardware, module and firmware of MON-VER: 30 bytes of software, 10 of hardware, 30 for each extension."""
    extensions = [_text(payload[begin : begin + 30]) for begin in range(40, len(payload) - 29, 30)]
    module = next((text[4:] for text in extensions if text.startswith("MOD=")), "")
    firmware = next((text[6:] for text in extensions if text.startswith("FWVER=")), _text(payload[:30]))
    hardware = _text(payload[30:40])
    parts = (module, f"hardware {hardware}" if hardware else "", f"firmware {firmware}" if firmware else "")
    return " ".join(("u-blox", *(part for part in parts if part))) if any(parts) else ""


def read_receiver_log(path: Path, progress: Progress) -> FlightLog:
    """Read the log of a receiver; it is one of u-blox where there is a u-blox frame in it, else one of NMEA.

    Raises InputError where the file cannot be read or has no intact message.
    """
    collector, tally = _Collector(), DamageTally()
    with opened(path) as stream:
        total = path.stat().st_size
        for batch in batches(stream, tally):
            collector.add(batch)
            progress("reading", min(batch.offset + len(batch.block), total), total)
    progress("reading", total, total)
    if not collector.counts:
        raise InputError(f"{path}: has no intact u-blox frame and no NMEA sentence: is it the receiver's recording?")
    messages = collector.messages()
    epochs = joined_epochs(messages)
    fixes = fix_types(messages, epochs)
    times = epoch_times(messages, epochs, fixes)
    table = ubx_fixes(messages, epochs, times, fixes)
    exposures, notes = no_exposures(), times.notes
    if "TIM-TM2" in messages:
        exposures, mark_notes = ubx_marks(messages["TIM-TM2"], epochs, times)
        notes += mark_notes
    if len(table) == 0:
        table, nmea_notes = collector.sentences.fixes()
        notes += nmea_notes
    return FlightLog(
        source=str(path),
        kind=LogKind.UBX if collector.frames else LogKind.NMEA,
        vehicle=collector.vehicle,
        fix_table=table,
        estimate_table=no_fixes(),
        attitude_table=no_attitudes(),
        exposure_table=exposures,
        message_counts=dict(sorted(collector.counts.items())),
        texts=tuple(text for text in collector.texts if text),
        damage=tally.result(),
        notes=(*notes, *_notes(table, collector.counts)),
    )


def _notes(table: FixTable, counts: Counter[str]) -> Iterator[str]:
    """Yield what is to be said of the positions and the raw measurements."""
    if len(table) == 0:
        yield "there are no positions in it"
    fixed = table.fix_type >= FixType.TWO_DIMENSIONAL
    placeless = int(np.sum(fixed & np.isnan(table.latitude_deg + table.longitude_deg)))
    if placeless:
        yield f"{placeless} rows with a fix have no valid position"
    timeless = int(np.sum(fixed & (table.when.gps_ns == NO_TIME)))
    if timeless:
        yield f"{timeless} positions have no GPS time"
    raw = sum(counts[name] for name in _RAW)
    if raw:
        yield f"{raw} epochs of raw measurements are kept for RINEX converters (uavkit.formats.ubx.raw_measurements)"
