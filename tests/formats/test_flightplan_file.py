"""Flight plans on disk."""

import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.plan.made_plans import made_plan
from uavkit.core.errors import InputError
from uavkit.core.flightplan import FlightPlan, Trigger
from uavkit.formats.flightplan_file import read_flightplan, write_flightplan


def identical(ours: Any, theirs: Any) -> bool:
    """Compare records to the last bit, nan being the same as nan."""
    if isinstance(ours, np.ndarray):
        return ours.dtype == theirs.dtype and ours.tobytes() == theirs.tobytes() and ours.shape == theirs.shape
    if hasattr(ours, "__dataclass_fields__"):
        return all(identical(getattr(ours, field.name), getattr(theirs, field.name)) for field in fields(ours))
    if isinstance(ours, tuple):
        return len(ours) == len(theirs) and all(map(identical, ours, theirs))
    return type(ours) is type(theirs) and (ours == theirs or (ours != ours and theirs != theirs))


@pytest.mark.parametrize("trigger", list(Trigger))
def test_round_trip_without_loss(trigger: Trigger, tmp_path: Path) -> None:
    plan = made_plan(trigger, sorties=2, bends=True, direction_deg=100.0 / 3.0)
    write_flightplan(tmp_path / "a.flightplan.json", plan)
    assert identical(plan, read_flightplan(tmp_path / "a.flightplan.json"))


def test_a_plan_without_exposures(tmp_path: Path) -> None:
    plan = made_plan()
    empty = {field.name: getattr(plan.exposures, field.name)[:0] for field in fields(plan.exposures)}
    plan = replace(plan, exposures=replace(plan.exposures, **empty), sorties=(), strips=())
    write_flightplan(tmp_path / "a.flightplan.json", plan)
    assert identical(plan, read_flightplan(tmp_path / "a.flightplan.json"))


def test_same_plan_same_bytes(tmp_path: Path) -> None:
    for name in "ab":
        write_flightplan(tmp_path / name, made_plan())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def edited(change: Callable[[dict[str, Any]], object], tmp_path: Path, plan: FlightPlan | None = None) -> Path:
    path = tmp_path / "x.flightplan.json"
    write_flightplan(path, plan or made_plan())
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return path


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda c: c.update(format="uavkit block"), "no flight plan"),
        (lambda c: c.update(version=2), "version 2"),
        (lambda c: c.pop("plan"), "FlightPlan"),
        (lambda c: c["plan"].update(camara="x"), "did you mean 'camera'"),
        (lambda c: c["plan"].update(trigger="DISTANT"), "plan.trigger should be one of DISTANCE"),
        (lambda c: c["plan"]["exposures"]["latitude_deg"]["values"].pop(), "latitude_deg is no array"),
        (lambda c: c["plan"]["exposures"]["time_s"].update(values=[0.0], shape=[1]), "time_s has not 15 rows"),
        (lambda c: c["plan"]["strips"].pop(), "strip that is not there"),
        (lambda c: c["plan"]["sorties"][0]["waypoints"][3].update(exposure=99), r"sorties\[0\] names"),
    ],
)
def test_damage_is_named(change: Callable[[dict[str, Any]], object], words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words) as caught:
        read_flightplan(edited(change, tmp_path))
    assert "x.flightplan.json" in str(caught.value)


def test_what_is_no_json(tmp_path: Path) -> None:
    path = tmp_path / "x.flightplan.json"
    with pytest.raises(InputError, match="cannot be read"):
        read_flightplan(path)
    for content in (b"", b"\xff", b"{", b"[" * 100_000):
        path.write_bytes(content)
        with pytest.raises(InputError, match="damaged"):
            read_flightplan(path)
