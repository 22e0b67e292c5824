"""The exceptions that uavkit raises.

UavkitError
    InputError           the user can mend it: a file, a value, an option, a full disk
    DeviceError          hardware or its link does not do what it should
    AdjustmentError      the observations do not determine the unknowns

The message says what is wrong, where (file, line, value), and what to do. ``cli`` shows it as one line, exit status 2.
"""

import difflib
from collections.abc import Iterable


class UavkitError(Exception):
    """Base of all errors that uavkit raises on purpose."""


class InputError(UavkitError):
    """Something that the user gave is wrong, and the user can mend it."""


class DeviceError(UavkitError):
    """A device, or the link to it, fails."""


class AdjustmentError(UavkitError):
    """The observations do not determine the unknowns."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" for the most similar of the known words, or nothing if none is near."""
    near = difflib.get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f"; did you mean {near[0]!r}?" if near else ""
