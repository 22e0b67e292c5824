"""Decisions by hand: a file that is written, edited and read again."""

import numpy as np
import pytest
from test_exposure_matching import exposure_stamps, flight, still_stamps

from uavkit.core.errors import InputError
from uavkit.core.exposures import StillState
from uavkit.formats.match_file import MatchRow, read_matches
from uavkit.ingest.exposure_matching import EventState, match_exposures
from uavkit.ingest.match_overrides import apply_overrides

TIMES = flight(40)
STILLS = still_stamps(np.delete(TIMES, 30) + 7.0, 0.01)
EVENTS = exposure_stamps(np.delete(TIMES, 12))


@pytest.fixture(scope="module")
def matching():
    return match_exposures(STILLS, EVENTS)


def override(matching, *rows):
    numbered = [MatchRow(image=image, event=event, line=k + 3) for k, (image, event) in enumerate(rows)]
    return apply_overrides(matching, STILLS.name, EVENTS, numbered, "match.csv")


def test_what_the_matching_found_changes_nothing(matching):
    rows = [(name, EVENTS.label[event]) for name, event in zip(STILLS.name, matching.event, strict=True) if event >= 0]
    result = override(matching, *rows, (STILLS.name[12], "none"))
    assert result.state == matching.state
    assert np.array_equal(result.event, matching.event)
    assert result.event_state == matching.event_state


@pytest.mark.parametrize("event", ["event 29", "30", "EVENT 29"])
def test_an_event_by_label_or_number(matching, event):
    result = override(matching, (STILLS.name[12], event))
    assert result.event[12] == 29
    assert result.state[12] is StillState.MATCHED
    assert result.probability[12] == 1.0
    assert result.reason[12] == "by hand"
    assert result.event_state[29] is EventState.MATCHED
    assert matching.state[12] is StillState.NO_EVENT  # the argument is not changed


def test_an_event_by_gps_time(matching):
    time_ns = int(EVENTS.gps_ns[29]) + 20_000_000
    result = override(matching, (STILLS.name[12].lower(), f"{time_ns // 10**9}.{time_ns % 10**9:09d}"))
    assert result.event[12] == 29


def test_none_frees_the_event(matching):
    result = override(matching, (STILLS.name[5], "none"))
    assert result.state[5] is StillState.NO_EVENT
    assert result.event[5] == -1
    assert result.event_state[5] is EventState.NO_STILL


def test_the_still_that_loses_its_event_is_ambiguous(matching):
    result = override(matching, (STILLS.name[12], "event 5"))
    assert result.event[12] == 5
    assert result.state[5] is StillState.AMBIGUOUS
    assert STILLS.name[12] in result.reason[5]


def test_two_images_may_change_places(matching):
    result = override(matching, (STILLS.name[5], "event 6"), (STILLS.name[6], "event 5"))
    assert result.event[5] == 6
    assert result.event[6] == 5
    assert result.state[5] is result.state[6] is StillState.MATCHED


@pytest.mark.parametrize(
    "rows, message",
    [
        ([("DSC0001.JPG", "none")], r"match.csv: line 3: there is no image 'DSC0001.JPG'; did you mean 'DSC0"),
        ([("DSC00001.JPG", "evnt 3")], r"'evnt 3' is no event.*did you mean 'event 3"),
        ([("DSC00001.JPG", "400")], r"numbered from 1 to 39"),
        ([("DSC00001.JPG", "0")], r"numbered from 1 to 39"),
        ([("DSC00001.JPG", "9" * 5000)], r"is no event"),
        ([("DSC00001.JPG", "-1")], r"'-1' is no event"),
        ([("DSC00001.JPG", "²")], r"'²' is no event"),
        ([("DSC00001.JPG", "9999999999.5")], r"'9999999999.5' is no event"),
        ([("DSC00001.JPG", "12.5")], r"no event is at GPS time 12.5: the nearest is \d+"),
        ([("DSC00001.JPG", "event 3"), ("DSC00002.JPG", "4")], r"line 4: event 3 is given to DSC00001.JPG and to"),
    ],
)
def test_what_cannot_be_is_refused(matching, rows, message):
    with pytest.raises(InputError, match=message):
        override(matching, *rows)


@pytest.mark.parametrize(
    "text, message",
    [
        ("image,event\n", "no row below its header"),
        ("image,evnt\na.jpg,1\n", "unknown column 'evnt'; did you mean 'event'"),
        ("image\na.jpg\n", "misses event"),
        ("image,event,event\na,1,1\n", "twice"),
        ("image,event\n,1\n", "line 2 names no image"),
        ("image,event\na.jpg,1\nA.JPG,2\n", "lines 2 and 3 both tell of A.JPG"),
    ],
)
def test_a_bad_file_is_refused(tmp_path, text, message):
    path = tmp_path / "match.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_matches(path)


def test_rows_left_empty_leave_the_decision(matching):
    result = override(matching, (STILLS.name[3], ""))
    assert np.array_equal(result.event, matching.event)
