"""Simulated flights through the whole chain, by the command line, each step measured.

Which cases there are is read from ``cases.toml``. A flight is rendered once and kept in ``rows.WORK``; ingest and
process are run anew for each row.
"""

import shutil
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

from tests.benchmarks.evaluation import evaluated
from tests.benchmarks.rows import WORK
from tests.benchmarks.subprocesses import THREADS, Finished, ProgramFailedError, run_measured
from uavkit.core.errors import InputError
from uavkit.formats.adjustment_file import read_oriented_block
from uavkit.project import Project
from uavkit.simulate.truth import read_truth

CASES = Path(__file__).with_name("cases.toml")
RENDER_THREADS = "1"
OPTIONAL = ("video", "control-points")
"""Originals that not every flight has."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One simulated flight and how it is processed."""

    benchmark: str
    name: str
    simulate: Mapping[str, Any]
    """Options of ``uavkit simulate`` by name; what is absent has its default."""
    settings: tuple[str, ...] = ()
    """Of ``uavkit process --set``."""
    positions: str = "positions.kml"
    """File of the flight that ``uavkit ingest`` is given."""
    without: tuple[str, ...] = ()
    """Originals that ``uavkit ingest`` is not given, by the name of the option."""

    @property
    def flight(self) -> Path:
        """Return the folder of the flight, named by what was asked for."""
        return WORK / "flights" / ",".join(f"{name}={value}" for name, value in sorted(self.simulate.items()))

    @property
    def survey(self) -> Path:
        """Return the folder of the survey."""
        return WORK / "surveys" / self.benchmark / self.name


TINY = Case(
    benchmark="compilation",
    name="tiny",
    simulate={"flight": "trace", "scale": 0.2, "strips": 2, "stations": 5, "frames_between_stills": 30},
    settings=("candidates.source=both",),
)


def cases(benchmark: str, path: Path = CASES) -> list[Case]:
    """Return the cases of a benchmark in the order of the file."""
    return list(_cases(benchmark, tomllib.loads(path.read_text(encoding="utf-8"))[benchmark]))


def _cases(benchmark: str, table: Mapping[str, Any]) -> Iterator[Case]:
    for name, varied in _variations(table):
        yield Case(
            benchmark=benchmark,
            name=name,
            simulate={**table.get("simulate", {}), **varied},
            settings=tuple(table.get("settings", ())),
            positions=table.get("positions", "positions.kml"),
            without=tuple(table.get("without", ())),
        )


def _variations(table: Mapping[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Return name and options of each case of a table: those listed by name, and all combinations of what varies."""
    yield from table.get("named", {}).items()
    vary: Mapping[str, list[Any]] = table.get("vary", {})
    for values in product(*vary.values()) if vary else ():
        varied = dict(zip(vary, values, strict=True))
        words = [value if isinstance(value, str) else f"{key} {value}" for key, value in varied.items()]
        yield ", ".join(words), varied


def rendered(flight: Path) -> bool:
    """Tell whether a flight is complete: all stills, and the video, which is written last."""
    try:
        truth = read_truth(flight / "truth" / "truth.json")
    except InputError:
        return False
    stills = sum(1 for _ in (flight / "stills").glob("*.JPG"))
    return stills == len(truth["exposures"]) and (truth["video"] is None or (flight / "video.avi").is_file())


def render(case: Case) -> Path:
    """Render the flight of a case, unless it is there."""
    if not rendered(case.flight):
        options = [word for name, value in case.simulate.items() for word in _option(name, value)]
        arguments = ["uavkit.cli", "simulate", str(case.flight), *options, "--workers", RENDER_THREADS]
        run_measured(arguments, WORK / "logs" / f"simulate {case.flight.name}.log")
    return case.flight


def _option(name: str, value: Any) -> list[str]:
    """Return the words of an option on the command line; true is a bare flag."""
    option = f"--{name.replace('_', '-')}"
    return [option] if value is True else [option, str(value)]


def ingest(case: Case) -> Finished:
    """Begin the survey of a case anew."""
    flight, survey = render(case), case.survey
    shutil.rmtree(survey, ignore_errors=True)
    originals = {
        "images": "stills",
        "video": "video.avi",
        "positions": case.positions,
        "control-points": "control_points.csv",
        "check-points": "check_points.csv",
    }
    known = {role: flight / name for role, name in originals.items() if role not in case.without}
    given = {role: path for role, path in known.items() if role not in OPTIONAL or path.is_file()}
    words = [word for role, path in given.items() for word in (f"--{role}", str(path))]
    return run_measured(["uavkit.cli", "ingest", str(survey), *words], _log(case, "ingest"))


def process(case: Case) -> Finished:
    """Process the survey of a case from the beginning: nothing of an earlier run is used but compiled code."""
    compile_kernels()
    return _process(case)


@cache
def compile_kernels() -> None:
    """Take a tiny flight through the chain, so that numba has compiled all: an installation does that once."""
    ingest(TINY)
    _process(TINY)


def _process(case: Case) -> Finished:
    shutil.rmtree(case.survey / "process", ignore_errors=True)
    settings = [word for setting in case.settings for word in ("--set", setting)]
    arguments = ["uavkit.cli", "process", str(case.survey), "--workers", str(THREADS), *settings]
    return run_measured(arguments, _log(case, "process"))


def _log(case: Case, step: str) -> Path:
    return WORK / "logs" / f"{case.benchmark} {case.name} {step}.log"


def oriented(case: Case) -> dict[str, Any]:
    """Take a case through the chain and return all that its row tells; a chain that gives up has oriented nothing."""
    truth = read_truth(render(case) / "truth" / "truth.json")
    compile_kernels()
    try:
        began, done = ingest(case), process(case)
    except ProgramFailedError as error:
        return {"stills": len(truth["exposures"]), "stills_oriented": 0, "failure": error.last_line}
    result = read_oriented_block(Project(case.survey).result_file)
    return {
        "ingest_s": began.wall_s,
        "process_s": done.wall_s,
        "process_processor_s": done.processor_s,
        "peak_mb": done.peak_mb,
        **evaluated(result, truth),
    }
