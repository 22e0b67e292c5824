"""Outputs appear whole or not at all: written to a temporary name beside their place, then moved into it."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from uavkit.core.errors import InputError


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path that replaces ``path`` when the block ends well, and vanishes when it does not.

    The temporary name keeps the suffix, for writers that choose the format by it. Raises InputError where the disk is
    full or the folder cannot be written.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise InputError(_cause(path, error)) from error
    finally:
        with suppress(OSError):  # whatever kept the file from being made is already told
            temporary.unlink(missing_ok=True)


def _cause(path: Path, error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{path}: the disk is full; nothing was changed there: free some space and run the same command again"
    return f"{path}: cannot be written ({error.strerror or error})"


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all; raises InputError as ``atomic_path`` does."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
