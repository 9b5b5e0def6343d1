"""Checks of errors by their fields, so that texts may change."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from neuma_lib.errors import InputError


@contextmanager
def refused(
    *where: object, problem: str = "", remedy: str = ""
) -> Iterator[pytest.ExceptionInfo[InputError]]:
    """The block raises an `InputError` of one line whose fields contain the given texts."""
    with pytest.raises(InputError) as caught:
        yield caught
    error = caught.value
    assert len(str(error).splitlines()) == 1, error
    missing = [text for text in map(str, where) if text not in error.where]
    assert not missing, f"{missing} not in where = {error.where!r} of: {error}"
    assert problem in error.problem and remedy in error.remedy, error
