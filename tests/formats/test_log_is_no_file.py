"""Pipes and devices have no end: they are refused at once, as are paths that cannot be."""

import os
from pathlib import Path

import pytest

from uavkit.core.errors import InputError
from uavkit.formats.flight_logs import open_log
from uavkit.project import Project


def test_a_pipe_that_nobody_writes_to_does_not_hold_the_reader(tmp_path: Path) -> None:
    pipe = tmp_path / "flight.BIN"
    os.mkfifo(pipe)
    for read in (open_log, Project(tmp_path / "survey").original):
        with pytest.raises(InputError, match="is a device or a pipe") as error:
            read(pipe)
        assert str(pipe) in str(error.value)


@pytest.mark.parametrize("device", ["/dev/zero", "/dev/full", "/dev/urandom", "/dev/null"])
def test_a_device_is_no_log(device: str) -> None:
    with pytest.raises(InputError, match="is a device or a pipe"):
        open_log(Path(device))
    with pytest.raises(InputError, match="is a device or a pipe"):
        Project(Path("survey")).original(Path(device))


@pytest.mark.parametrize("name", ["a" * 300, "none.BIN", "file/none.BIN"])
def test_a_path_that_cannot_be_is_named(name: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for read in (open_log, Project(tmp_path / "survey").original):
        with pytest.raises(InputError) as error:
            read(tmp_path / name)
        assert name in str(error.value)


def test_a_circle_of_links_is_named(tmp_path: Path) -> None:
    (tmp_path / "circle.BIN").symlink_to(tmp_path / "circle.BIN")
    for read in (open_log, Project(tmp_path / "survey").original):
        with pytest.raises(InputError, match=r"circle\.BIN"):
            read(tmp_path / "circle.BIN")
