"""Pictures and measured tables are of this code."""

import pytest
from pages import loaded


@pytest.mark.parametrize("dear", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_no_picture_and_no_table_is_older_than_what_it_is_made_from(dear):
    """`python docs/make.py` makes what is older; the fast test leaves out what takes more than minutes."""
    make = loaded("make")
    assert [name for name in make.older() if dear or name not in make.MINUTES] == []
