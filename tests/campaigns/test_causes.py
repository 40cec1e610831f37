"""A few stages in every test run; the long campaign is started by hand (tests/campaigns/causes.py)."""

from __future__ import annotations

import pytest

from tests.campaigns.causes import named


@pytest.mark.parametrize(("seed", "kind", "names"), [(0, "nothing", False), (1, "dim", True), (3, "response", True)])
def test_a_refining_names_what_changed_and_nothing_else(seed: int, kind: str, names: bool) -> None:
    found = named(seed)
    assert found.kind == kind
    assert not found.wrong
    assert bool(found.named) is names
