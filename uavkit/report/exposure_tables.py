"""The report's part on stills and exposures: which belongs to which, how sure, and what the camera's clock does."""

from uavkit.core.exposures import ExposureMatches, StillState
from uavkit.core.gpstime import utc_from_gps_time_ns
from uavkit.formats.html_page import Table, number

COLLAPSE_ABOVE = 12


def clock_table(matches: ExposureMatches) -> Table:
    """Return the settings of the camera's clock."""
    rows = tuple(
        (
            f"{clock.stills[0]} to {clock.stills[-1]}",
            str(len(clock.stills)),
            f"{clock.offset_s:+.3f} ± {number(clock.offset_sigma_s, 3)}",
            f"{clock.drift_ppm:+.1f} ± {number(clock.drift_sigma_ppm, 1)}",
            number(1e3 * clock.residual_s, 1),
        )
        for clock in matches.clocks
    )
    header = ("Stills", "Number", "Offset from UTC [s]", "Drift [ppm]", "RMS residual [ms]")
    note = "Stamps of whole seconds leave residuals of 289 ms (rounding): that is no error." if rows else ""
    return Table(title="The camera's clock", header=header, rows=rows, note=note)


def exposures_table(matches: ExposureMatches) -> Table:
    """Return each still with its exposure."""
    rows = tuple(
        (
            entry.still,
            entry.state.value,
            "" if entry.event is None else str(entry.event),
            "" if entry.gps_time_ns is None else _clock_time(entry.gps_time_ns),
            number(entry.probability, 4) if entry.event is not None else "",
            entry.reason,
        )
        for entry in matches.stills
    )
    header = ("Still", "State", "Exposure", "UTC of the exposure", "Probability", "Remark")
    return Table(title="Stills and their exposures", header=header, rows=rows, folded=len(rows) > COLLAPSE_ABOVE)


def unused_table(matches: ExposureMatches) -> Table:
    """Return the exposures that no still has."""
    rows = tuple((entry.source, _clock_time(entry.gps_time_ns), entry.reason) for entry in matches.unused)
    return Table(
        title="Exposures without a still",
        header=("Exposure", "UTC of the event", "Reason"),
        rows=rows,
        folded=len(rows) > COLLAPSE_ABOVE,
    )


def summary_sentence(matches: ExposureMatches) -> str:
    """Return how many stills have their exposure."""
    count = {state: sum(entry.state is state for entry in matches.stills) for state in StillState}
    sure = count[StillState.MATCHED] + count[StillState.GIVEN] + count[StillState.DOUBLED]
    text = f"{sure} of {len(matches.stills)} stills have their exposure among {matches.events} in the logs"
    if count[StillState.GIVEN]:
        text += f" ({count[StillState.GIVEN]} of them as told by the user)"
    if count[StillState.AMBIGUOUS]:
        text += f"; {count[StillState.AMBIGUOUS]} are ambiguous, and their exposures are not used"
    if matches.shutter_latency_s:
        text += f". Shutter latency as stated: {1e3 * matches.shutter_latency_s:g} ms"
    if any(matches.lever_arm_m):
        text += ". Antenna from the camera, forward, right, down: {:g}, {:g}, {:g} m".format(*matches.lever_arm_m)
    return text + "."


def _clock_time(gps_time_ns: int) -> str:
    return utc_from_gps_time_ns(gps_time_ns).strftime("%H:%M:%S.%f")[:-3]
