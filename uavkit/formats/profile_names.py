"""Profiles found by name: case, blanks, hyphens and underscores do not count."""

import re
from collections.abc import Mapping, Sequence

from uavkit.core.errors import InputError, did_you_mean


def plain_name(name: str) -> str:
    """Return a name as it is compared."""
    return re.sub(r"[\s\-_]+", "", name.casefold())


def profile_named(kind: str, name: str, profiles: Mapping[str, Sequence[str]]) -> str:
    """Return the key of the profile that has a name; profiles: its names by key, the usual one first.

    Raises InputError for an unknown name, with the nearest one.
    """
    wanted = plain_name(name)
    for key, names in profiles.items():
        if wanted and wanted in {plain_name(known) for known in names}:
            return key
    usual = [names[0] for names in profiles.values()]
    spellings = {plain_name(known): known for known in usual}
    near = did_you_mean(wanted, spellings) or did_you_mean(name, usual)
    for plain, spelling in spellings.items():
        near = near.replace(f"{plain!r}", f"{spelling!r}")
    raise InputError(f"there is no {kind} {name!r}{near} Known: {', '.join(usual)}; or give a TOML file of your own")
