"""Progress of long work, reported through a callable that is passed in."""

from typing import Protocol


class Progress(Protocol):
    """Called as ``progress(stage, done, total)``; whoever shows it works out the time left."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Take note that ``done`` of ``total`` units of the stage are finished."""


def silent(stage: str, done: int, total: int) -> None:
    """Take no note of progress."""
