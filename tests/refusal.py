"""The error with which bad input is refused."""

import pytest

from factorlib.errors import InputError


def refusal(words: str, call, *arguments, **named) -> InputError:
    """The error of a call; it says the words, a regular expression, and how to mend what is wrong."""
    with pytest.raises(InputError, match=words) as caught:
        call(*arguments, **named)
    assert caught.value.cure
    return caught.value
