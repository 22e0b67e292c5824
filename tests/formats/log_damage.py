"""Damage as downloads, cards and radio links do it, at a random place of a log."""

from dataclasses import dataclass

import numpy as np

KINDS = ("cut", "zeroed", "repeated", "flipped")


@dataclass(frozen=True, kw_only=True)
class Damaged:
    """A damaged log, and where in the intact one lies what is still whole in it."""

    data: bytes
    kind: str
    intact: tuple[tuple[int, int, int], ...]
    """Spans (begin, end, offset): the bytes begin to end of the intact log stand, unchanged, ``offset`` further on."""

    def moved(self, begin: int, end: int) -> int | None:
        """Return where in the damaged log a message of the intact one begins, None where damage touched it."""
        for a, b, offset in self.intact:
            if a <= begin and end <= b:
                return begin + offset
        return None


def damaged(data: bytes, rng: np.random.Generator, longest: int = 400) -> Damaged:
    """Return the log with one damage of a random kind, place and length (1 to ``longest`` bytes)."""
    kind = KINDS[int(rng.integers(len(KINDS)))]
    length = int(rng.integers(1, longest + 1))
    begin = int(rng.integers(0, max(1, len(data) - length)))
    end = min(begin + length, len(data))
    before, span, after = data[:begin], data[begin:end], data[end:]
    if kind == "cut":
        return Damaged(data=before + after, kind=kind, intact=((0, begin, 0), (end, len(data), begin - end)))
    if kind == "zeroed":
        return Damaged(data=before + bytes(end - begin) + after, kind=kind, intact=((0, begin, 0), (end, len(data), 0)))
    if kind == "repeated":
        return Damaged(
            data=before + span + span + after, kind=kind, intact=((0, end, 0), (begin, len(data), end - begin))
        )
    place = int(rng.integers(begin, end))
    flipped = bytearray(data)
    flipped[place] ^= 1 << int(rng.integers(8))
    return Damaged(data=bytes(flipped), kind=kind, intact=((0, place, 0), (place + 1, len(data), 0)))
