"""Pipes and devices have no end: they are refused at once, as are paths that cannot be; logs are never overwritten."""

import os
from pathlib import Path

import pytest

from tests.formats.media import write_jpeg
from uavkit.core.errors import InputError
from uavkit.formats.flight_logs import open_log
from uavkit.formats.image_files import FileStillSource
from uavkit.formats.log_export import ExportKind, export_log
from uavkit.project import Project

BROKEN = Path(__file__).resolve().parents[2] / "sim_logs/broken_logs"


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


@pytest.mark.parametrize(
    ("kind", "words"), [("pipe", "a pipe or a device"), ("link", "a link to nothing"), ("folder", "a folder")]
)
def test_what_is_named_like_a_still_but_is_none_is_named(kind: str, words: str, tmp_path: Path) -> None:
    write_jpeg(tmp_path / "b.jpg")
    path = tmp_path / "a.jpg"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "link":
        path.symlink_to(tmp_path / "nowhere.jpg")
    else:
        path.mkdir()
    with pytest.raises(InputError, match=f"a.jpg: is {words}"):
        FileStillSource(tmp_path)


def test_a_folder_that_must_not_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(_: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refused)
    with pytest.raises(InputError, match=r"cannot be read \(Permission denied\)"):
        FileStillSource(tmp_path)


@pytest.mark.parametrize(("name", "kind"), [("no_times.kml", ExportKind.KML), ("gpx_cut.gpx", ExportKind.GPX)])
def test_an_export_does_not_overwrite_the_log_that_it_was_read_from(
    name: str, kind: ExportKind, tmp_path: Path
) -> None:
    """By its folder, by its own name, by a link to it."""
    content = (BROKEN / name).read_bytes()
    path = tmp_path / name
    path.write_bytes(content)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / name).symlink_to(path)
    log = open_log(path)
    for out in (tmp_path, path, tmp_path / "other"):
        with pytest.raises(InputError, match="is the log itself"):
            export_log(log, out, kind)
        assert path.read_bytes() == content
    (written,) = export_log(log, tmp_path / "third", kind)
    assert written.read_bytes() != content


def test_an_export_into_a_folder_that_must_not_be_entered_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = open_log(BROKEN / "no_times.kml")

    def refused(path: Path, _: object) -> bool:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "samefile", refused)
    with pytest.raises(InputError, match=r"no_times.kml: cannot be written \(Permission denied\)"):
        export_log(log, tmp_path / "out", ExportKind.KML)
