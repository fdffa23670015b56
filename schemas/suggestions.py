"""The name that a wrong name probably means: of an option, a part of a form, a setting, or an error code."""

from __future__ import annotations

import difflib
from collections.abc import Collection

OTHER_WORDS = {"mask": "region"}
"""Other words for names of Pliant that are not spelled alike."""

SIMILAR = 0.6
"""Smallest similarity of two names, as `difflib` measures it; its own default."""

LONGEST = 40
"""Longest name that is compared, characters: the comparison takes quadratic time, and every name of Pliant is shorter."""


def closest(name: str, known: Collection[str]) -> str | None:
    """Return the known name that is spelled most like `name`, begins it, or begins with it; None if there is none."""
    given = name.lower().replace("-", "_")
    if not 2 < len(given) <= LONGEST:
        return None
    if OTHER_WORDS.get(given) in known:
        return OTHER_WORDS[given]
    compared = {each: difflib.SequenceMatcher(None, given, each.replace("-", "_")).ratio() for each in known}
    similar = [
        each for each, ratio in compared.items() if ratio >= SIMILAR or given.startswith(each) or each.startswith(given)
    ]
    return max(similar, key=compared.__getitem__, default=None)
