"""Broken logs: of each all that is intact is found, what is lost is counted, and what is none is said in one line."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.sim_logs.broken_recipes import FOLDER, RECIPES, about
from uavkit.cli import EXIT_ERROR, app
from uavkit.core.errors import InputError
from uavkit.formats.flight_logs import open_log
from uavkit.formats.log_summary import log_summary

ABOUT = tomllib.loads((FOLDER / "ABOUT.toml").read_text(encoding="utf-8"))
LOGS = {log["file"]: log for log in ABOUT["log"]}
READ = {name: log for name, log in LOGS.items() if "error" not in log}
REFUSED = {name: log["error"] for name, log in LOGS.items() if "error" in log}
RUNNER = CliRunner()


def test_files_and_page_are_those_of_the_recipes() -> None:
    """But for compressed archives, whose bytes are of the version of the library that packed them."""
    made = {name: make() for name, make in RECIPES.items()}
    for name, broken in made.items():
        assert name == "zip_bomb.kmz" or (FOLDER / name).read_bytes() == broken.data, name
    without_sums = [text.partition("[sha256]")[0] for text in (about(made), (FOLDER / "ABOUT.toml").read_text())]
    assert without_sums[0] == without_sums[1]


def test_they_are_small() -> None:
    sizes = {path.name: path.stat().st_size for path in FOLDER.iterdir()}
    assert max(sizes.values()) < 60_000
    assert sum(sizes.values()) < 500_000


@pytest.mark.parametrize("name", READ)
def test_what_is_intact_is_found_and_what_is_lost_is_counted(name: str) -> None:
    expected = READ[name]
    log = open_log(FOLDER / name)
    assert len(log.exposure_table) == expected["exposures"]
    assert len(list(log.fixes())) == expected["fixes"]
    assert log.damage.lost_bytes == expected["lost_bytes"]
    assert any(expected.get("note", "") in note for note in (*log.notes, ""))
    assert (log_summary(log)["begin_utc"] or "").startswith(expected.get("first_utc", ""))


@pytest.mark.parametrize("name", READ)
def test_the_command_line_tells_of_it(name: str) -> None:
    answer = RUNNER.invoke(app, ["log", "info", str(FOLDER / name)])
    assert answer.exit_code == 0
    lines = answer.stdout.splitlines()
    assert any(READ[name].get("note", "") in line for line in lines)
    told = next(line for line in lines if line.startswith("damage"))
    assert (told == "damage    none") == (READ[name]["lost_bytes"] == 0)


@pytest.mark.parametrize("name", [name for name in REFUSED if name != "zip_bomb.kmz"])  # once, below: it takes seconds
def test_what_is_no_log_is_refused_with_the_reason(name: str) -> None:
    with pytest.raises(InputError) as error:
        open_log(FOLDER / name)
    assert REFUSED[name] in str(error.value)
    assert str(FOLDER / name) in str(error.value) or str(name) in str(error.value)


@pytest.mark.parametrize(
    ("command", "name"),
    [(["info"], name) for name in REFUSED]
    + [(["export", "--to", "csv"], name) for name in ("empty.BIN", "dataflash_formats_lost.BIN", "latitude_first.kml")],
    ids=str,
)
def test_the_command_line_ends_with_one_line_and_status_2(command: list[str], name: str, tmp_path: Path) -> None:
    out = ["--out", str(tmp_path / "out")] if command[0] == "export" else []
    answer = RUNNER.invoke(app, ["log", command[0], str(FOLDER / name), *command[1:], *out])
    assert answer.exit_code == EXIT_ERROR
    assert isinstance(answer.exception, SystemExit)
    assert answer.stdout == ""
    *progress, line = answer.stderr.splitlines()
    assert all(text.startswith("reading") for text in progress)
    assert line.startswith("uavkit: ")
    assert REFUSED[name] in line
    assert list(tmp_path.iterdir()) == []


def test_sessions_of_a_telemetry_log_keep_their_times() -> None:
    """Of two flights between which the vehicle was restarted: boot times repeat, GPS times are those of each alone.

    Each is tied to GPS time by a fifth of the recorded pairs: to a millisecond, where each pair is off by 0.3 ms.
    """
    both = open_log(FOLDER / "tlog_reboot.tlog")
    folders = [FOLDER.parent / name for name in ("sitl_distance_trigger", "sitl_waypoint_trigger")]
    alone = [open_log(folder / "flight.tlog") for folder in folders]
    exposures = [log.exposure_table.when.gps_ns.tolist() for log in alone]
    assert both.exposure_table.when.gps_ns.tolist() == [*exposures[0], *exposures[1]]
    known = np.sort(np.concatenate([log.attitude_table.when.gps_ns for log in alone]))
    found = both.attitude_table.when.gps_ns
    near = np.clip(np.searchsorted(known, found), 1, len(known) - 1)
    apart_ns = np.minimum(np.abs(found - known[near]), np.abs(found - known[near - 1]))
    assert len(found) > 90
    assert apart_ns.max() < 1_000_000


def test_a_ground_station_that_sets_its_clock_does_not_move_the_exposures() -> None:
    moved = open_log(FOLDER / "tlog_clock_jumps.tlog").exposure_table.when.gps_ns
    alone = open_log(FOLDER.parent / "sitl_distance_trigger/flight.tlog").exposure_table.when.gps_ns
    assert moved.tolist() == alone.tolist()
