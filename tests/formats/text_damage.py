"""What a reader of a text says is lost holds nothing, and all else is of use: checked by reading both by themselves."""

from collections.abc import Callable

import pytest

from uavkit.core.errors import InputError
from uavkit.core.flight_log import FlightLog


def check_lost_bytes(data: bytes, log: FlightLog, read: Callable[[bytes], FlightLog], head: bytes = b"") -> None:
    """Check a log of damaged data; ``head`` is what is read before each part, such as the names of columns."""
    without = data
    assert log.damage.lost_bytes == sum(span.length for span in log.damage.spans)
    for span in reversed(log.damage.spans):
        part = without[span.offset : span.offset + span.length]
        without = without[: span.offset] + b"\n" + without[span.offset + span.length :]
        if head:
            assert read(head + part).message_counts == read(head).message_counts
            continue
        with pytest.raises(InputError):
            read(part)
    again = read(without)
    assert again.damage.lost_bytes == 0
    for table, other in (
        (log.fix_table, again.fix_table),
        (log.exposure_table, again.exposure_table),
        (log.attitude_table, again.attitude_table),
    ):
        assert len(table) == len(other)
    assert log.message_counts == again.message_counts
