"""Suggestions for a misspelt word."""

import difflib
from collections.abc import Iterable

# By what a table of a spectrum has instead of the number of a law.
_INSTEAD = {"sq": "height_factor"}


def close(word: str, words: Iterable[str]) -> list[str]:
    """The words most like `word`, a few, whatever the case of their letters."""
    spellings: dict[str, list[str]] = {}
    for each in words:
        spellings.setdefault(each.lower(), []).append(each)
    low = word.lower()
    inside = [x for x in spellings if min(len(low), len(x)) > 1 and (low in x or x in low)]
    # Below this share of equal letters words have little in common: nonsense and scene.
    near = difflib.get_close_matches(low, spellings, cutoff=0.65)
    instead = [x for x in (_INSTEAD.get(low),) if x in spellings and low not in spellings]
    near = list(dict.fromkeys([*instead, *near, *inside]))
    same = sorted(near, key=lambda each: each != low)  # only the case differs
    # Beside a function comes the class of what it returns: first the one in the case of the word.
    return [
        each
        for lower in same
        for each in sorted(spellings[lower], key=lambda x: x[:1].isupper() != word[:1].isupper())
    ][:3]


def did_you_mean(word: str, words: Iterable[str]) -> str:
    """ ": did you mean ...?" with the words most like `word`, or nothing."""
    near = close(word, words)
    return f": did you mean {' or '.join(near)}?" if near else ""
