"""The worked requests in flightplans/: planned anew they give the plans that lie beside them.

``UAVKIT_UPDATE_PLANS=1`` writes these plans anew instead: look at what changed before you keep it.
"""

import os
import re
import shutil
from pathlib import Path

import pytest

from uavkit import workflow
from uavkit.formats.plan_request import request_of

FOLDER = Path(__file__).resolve().parents[1] / "flightplans"
REQUESTS = sorted(FOLDER.glob("*.toml"))
KEPT = (".plan", ".kml")
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")


def kept(folder: Path, name: str) -> dict[str, Path]:
    """The files of a plan that are kept: those of all sorties."""
    pattern = re.compile(rf"{re.escape(name)}(_\d+)?$")
    return {path.name: path for path in folder.iterdir() if path.suffix in KEPT and pattern.match(path.stem)}


def same(before: str, now: str) -> bool:
    """Tell whether two texts are equal but for the last digits of their numbers (0.2 m on the ground at most)."""
    if NUMBER.sub("#", before) != NUMBER.sub("#", now):
        return False
    pairs = zip(NUMBER.findall(before), NUMBER.findall(now), strict=True)
    return all(a == b or abs(float(a) - float(b)) <= (2e-6 if len(a.partition(".")[2]) > 5 else 0.2) for a, b in pairs)


@pytest.mark.parametrize("request_file", REQUESTS, ids=lambda path: path.stem)
def test_request_gives_the_plan_beside_it(request_file: Path, tmp_path: Path) -> None:
    request = request_of(request_file, {})
    workflow.plan(request, FOLDER, tmp_path / "made")
    made, known = kept(tmp_path / "made", request.name), kept(FOLDER, request.name)
    if os.environ.get("UAVKIT_UPDATE_PLANS") == "1":
        for path in known.values():
            path.unlink()
        for path in made.values():
            shutil.copy(path, FOLDER)
        pytest.skip(f"{request.name}: written anew")
    assert sorted(made) == sorted(known)
    for name, path in made.items():
        assert same(known[name].read_text(encoding="utf-8"), path.read_text(encoding="utf-8")), name


def test_there_are_plans_to_learn_from() -> None:
    assert len(REQUESTS) >= 5
    for path in REQUESTS:
        assert path.read_text(encoding="utf-8").startswith("# ")
        assert f"`{path.name}`" in (FOLDER / "README.md").read_text(encoding="utf-8")


def test_numbers_may_differ_in_their_last_digits_only() -> None:
    assert same("a 1.0 b 47.1234567", "a 1.1 b 47.1234570")
    assert not same("a 1.0", "a 1.5")
    assert not same("47.1234567", "47.1235567")
    assert not same("a 1.0", "b 1.0")
    assert not same("1.0 2.0", "1.0")
