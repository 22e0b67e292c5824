"""Steps of long work whose results are kept under the hash of all that they depend on."""

from collections.abc import Callable
from typing import Any, Protocol

from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]


class StepCache(Protocol):
    """Keeps the arrays that a step gave; a killed run finds those of its finished steps again."""

    def arrays(self, step: str, key: str, compute: Callable[[], Arrays]) -> Arrays:
        """Return the arrays kept for (step, key), or compute, keep and return them.

        ``key`` is a hash (``content_hash``) over everything that the result depends on: inputs, options, and the
        version of the step's algorithm.
        """


class NoCache:
    """Keeps nothing."""

    def arrays(self, step: str, key: str, compute: Callable[[], Arrays]) -> Arrays:  # noqa: ARG002
        """Compute and return."""
        return compute()
