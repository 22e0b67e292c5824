"""Numbers on the command line that cannot be meant are refused there, before anything is kept of them."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from uavkit.cli import EXIT_ERROR, app

RUNNER = CliRunner()


@pytest.mark.parametrize(
    ("option", "value"),
    [
        *(("--lever-arm", text) for text in ("1;2;3", "0,2,0,1", "a,b,c", "", "nan,0,0", "inf,0,0", "1e9,0,0")),
        *(("--shutter-latency", text) for text in ("nan", "1e12", "-100", "soon")),
        *(("--latency-sigma", text) for text in ("nan", "inf", "-1", "1e300")),
    ],
)
def test_no_survey_begins_with_such_a_value(option: str, value: str, tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    survey = tmp_path / "survey"
    answer = RUNNER.invoke(app, ["ingest", str(survey), "--images", str(tmp_path / "images"), f"{option}={value}"])
    assert answer.exit_code == EXIT_ERROR
    assert option in answer.stderr
    assert "Traceback" not in answer.stderr
    assert not survey.exists()
