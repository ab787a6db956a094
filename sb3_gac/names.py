"""Names that may be meant by unknown ones, for messages."""

import re
from collections.abc import Iterable
from difflib import get_close_matches


def meant(name: str, known: Iterable[str], nearness: float = 0.7) -> str:
    """
    Find the name that may be meant by an unknown one.

    :param name: name that is not known
    :param known: known names
    :param nearness: least likeness of the two names, from 0 to 1
    :return: question that a message may end with, after a space: whether the known name is meant that is nearly the same, or
        that has all words of the unknown one; the empty text if there is no such name
    """
    by_small_letters = {each.casefold(): each for each in known}
    words = [word for word in re.split(r"[\W_]+", name.casefold()) if word]
    close = get_close_matches(name.casefold(), by_small_letters, n=1, cutoff=nearness)
    close = close or [each for each in by_small_letters if words and all(word in each for word in words)]
    return f' Is "{by_small_letters[close[0]]}" meant?' if close else ""
