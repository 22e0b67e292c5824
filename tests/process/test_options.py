"""Options of process: settings as text, their types, ranges and the help that a slip gets."""

import re
from dataclasses import fields
from pathlib import Path

import pytest

from uavkit.core.errors import InputError
from uavkit.process import options as options_module
from uavkit.process.options import (
    AdjustmentSection,
    CandidateOptions,
    CandidateSource,
    MeasurementOptions,
    ProcessOptions,
    with_settings,
)

SECTIONS = {"candidates": CandidateOptions, "measurement": MeasurementOptions, "adjustment": AdjustmentSection}


def test_settings_take_the_type_of_the_option() -> None:
    changed = with_settings(
        ProcessOptions(),
        ["candidates.source=both", " measurement.window_px = 21 ", "adjustment.tukey_c=7.5", "adjustment.gnss=no"],
    )
    assert changed.candidates.source is CandidateSource.BOTH
    assert changed.measurement.window_px == 21
    assert isinstance(changed.measurement.window_px, int)
    assert changed.adjustment.tukey_c == 7.5
    assert changed.adjustment.gnss is False
    assert changed.adjustment.self_calibration is True
    assert changed.measurement.least_correlation == ProcessOptions().measurement.least_correlation


def test_later_settings_win_and_earlier_ones_stay() -> None:
    changed = with_settings(ProcessOptions(), ["candidates.cells=10", "candidates.per_cell=3", "candidates.cells=12"])
    assert (changed.candidates.cells, changed.candidates.per_cell) == (12, 3)


@pytest.mark.parametrize("text,value", [("true", True), ("Yes", True), ("1", True), ("FALSE", False), ("0", False)])
def test_truth_values(text: str, value: bool) -> None:
    options = with_settings(ProcessOptions(), [f"adjustment.self_calibration={text}"])
    assert options.adjustment.self_calibration is value


@pytest.mark.parametrize(
    "setting,words",
    [
        ("window_px=31", "section.option=value"),
        ("measurement.window_px", "section.option=value"),
        ("mesurement.window_px=31", "did you mean 'measurement'"),
        ("measurement.windows_px=31", "did you mean 'window_px'"),
        ("measurement.window_px=large", "'large' does not fit"),
        ("measurement.window_px=31.5", "'31.5' does not fit"),
        ("candidates.source=films", "auto, video, features, both"),
        ("adjustment.gnss=perhaps", "'perhaps' does not fit"),
        ("measurement.window_px=30", "odd"),
        ("measurement.window_px=63", "11 to 61"),
        ("adjustment.tukey_c=4.9", "5 to 9"),
        ("adjustment.tukey_c=nan", "5 to 9"),
    ],
)
def test_slips_are_refused_with_help(setting: str, words: str) -> None:
    with pytest.raises(InputError, match=re.escape(words)):
        with_settings(ProcessOptions(), [setting])


def _stated_range(text: str) -> tuple[float, float] | None:
    found = re.search(r"([\d.]+) to ([\d.]+)", text)
    return (float(found[1]), float(found[2].rstrip("."))) if found else None


def _documented() -> list[tuple[str, str, str]]:
    """Section, option and the text below it, from the module's source."""
    source = Path(options_module.__file__).read_text(encoding="utf-8")
    result = []
    for section, kind in SECTIONS.items():
        body = source.split(f"class {kind.__name__}:")[1].split("def __post_init__")[0]
        for option in fields(kind):
            match = re.search(rf'\n    {option.name}: [^\n]*\n    """(.*?)"""', body, re.DOTALL)
            result.append((section, option.name, match[1] if match else ""))
    return result


@pytest.mark.parametrize("section,name,text", _documented())
def test_every_option_is_explained_and_its_stated_range_holds(section: str, name: str, text: str) -> None:
    present = getattr(SECTIONS[section](), name)
    if isinstance(present, CandidateSource):
        return  # its values explain themselves and are listed in the refusal
    assert text, f"{section}.{name} is not explained"
    if isinstance(present, bool):
        return
    stated = _stated_range(text)
    assert stated is not None, f"{section}.{name}: no range in {text!r}"
    least, most = (type(present)(bound) for bound in stated)
    step = 1 if isinstance(present, int) else 1e-6
    for inside in (least, most):
        with_settings(ProcessOptions(), [f"{section}.{name}={inside}"])
    for outside in (least - step, most + step):
        with pytest.raises(InputError, match=f"{section}.{name}"):
            with_settings(ProcessOptions(), [f"{section}.{name}={outside}"])
