"""Comma-separated values with keys in comment lines, as spreadsheets write them: uavkit's points and positions."""

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from uavkit.core.errors import InputError, did_you_mean


def comment_keys(path: Path, lines: Sequence[str], known: Sequence[str]) -> dict[str, tuple[int, str]]:
    """Return the keys in comment lines, each with its line number; a key that is nearly a known one is an error."""
    keys: dict[str, tuple[int, str]] = {}
    for number, line in enumerate(lines, start=1):
        found = re.match(r"\s*#\s*(\w+)\s*:\s*(.*?)[\s,]*$", line)  # spreadsheets pad comments with commas
        if found is None:
            continue
        key, value = found[1].lower(), found[2].strip().strip('"')
        if key in known:
            keys[key] = (number, value)
        elif hint := did_you_mean(key, list(known)):
            raise InputError(f"{path}: line {number}: unknown key {key!r}{hint}")
    return keys


def rows_of_cells(
    path: Path, lines: Sequence[str], check_header: Callable[[str, list[str]], None]
) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield line number and cells by column of each row; ``check_header`` gets the place and the names of columns."""
    header: list[str] | None = None
    for number, line in enumerate(lines, start=1):
        if not line.strip(" ,\t") or line.lstrip().startswith("#"):
            continue
        cells = [cell.strip() for cell in next(csv.reader([line]))]
        if header is None:
            header = [cell.lower() for cell in cells]
            check_header(f"{path}: line {number}", header)
            continue
        if len(cells) != len(header):
            hint = ": decimal commas are not accepted, write decimal points" if len(cells) > len(header) else ""
            raise InputError(f"{path}: line {number} has {len(cells)} cells, the header {len(header)}{hint}")
        yield number, dict(zip(header, cells, strict=True))


def text_lines(path: Path) -> list[str]:
    """Return the lines of a UTF-8 text; raises InputError where it cannot be read, or is none."""
    try:
        return path.read_bytes().decode("utf-8-sig").splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no UTF-8 text (byte {error.start}): save it as UTF-8") from error
