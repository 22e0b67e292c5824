"""GPS times for the records of a log that knows only its boot clock."""

from dataclasses import replace
from typing import TypeVar

import numpy as np

from uavkit.core.clock_fit import ClockFit
from uavkit.core.flight_log import AttitudeTable, ExposureTable, FixTable
from uavkit.core.gpstime import NO_TIME

Table = TypeVar("Table", FixTable, AttitudeTable, ExposureTable)


def with_gps_times(table: Table, clock: ClockFit | None) -> Table:
    """Return a table whose unknown GPS times are those of its boot times, as far as the clock tells."""
    if clock is None:
        return table
    when = table.when
    gps_ns = np.where(when.gps_ns == NO_TIME, clock.gps_ns(when.boot_ns), when.gps_ns)
    return replace(table, when=replace(when, gps_ns=gps_ns))
