"""A page that two files of tests look at."""

from collections.abc import Iterator

import pytest

from palpate.web.access import Access
from tests.factories.shown_page import Shown


@pytest.fixture
def shown() -> Iterator[Shown]:
    """A page that shows a shift."""
    one = Shown(Access(0))
    with one:
        one.shift()
        yield one
