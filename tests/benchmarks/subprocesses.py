"""Programs run as a user runs them, with their time and their peak memory."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
THREADS = 2
"""Of uavkit and of its peers alike."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finished:
    """What a program took; ``peak_mb`` is that of the program or of a child it waited for, whichever is larger."""

    wall_s: float
    processor_s: float
    peak_mb: float
    said: str


class ProgramFailedError(Exception):
    """A program that ended with an error; ``last_line`` is what it said last."""

    def __init__(self, arguments: Sequence[str], status: int, said: str) -> None:
        """Word the error."""
        self.last_line = said.strip().splitlines()[-1] if said.strip() else f"exit status {status}"
        super().__init__(f"{' '.join(arguments)}: exit status {status}: {said[-2000:]}")


def run_measured(arguments: Sequence[str], log: Path) -> Finished:
    """Run ``python -m ARGUMENTS`` of this checkout and keep what it says in a file.

    Raises ProgramFailedError where it ends with an error.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NO_COLOR": "1"}
    begin = time.perf_counter()
    with log.open("w", encoding="utf-8") as file:
        child = subprocess.Popen(
            [sys.executable, "-m", *arguments], cwd=ROOT, env=environment, stdout=file, stderr=subprocess.STDOUT
        )
        _, status, usage = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    wall_s = time.perf_counter() - begin
    said = log.read_text(encoding="utf-8", errors="replace")
    if child.returncode:
        raise ProgramFailedError(arguments, child.returncode, said)
    bytes_per_unit = 1 if sys.platform == "darwin" else 1024
    return Finished(
        wall_s=wall_s,
        processor_s=usage.ru_utime + usage.ru_stime,
        peak_mb=usage.ru_maxrss * bytes_per_unit / 1024.0**2,
        said=said,
    )
