"""``velatura study`` as it is typed."""

from __future__ import annotations

import json

import pytest

from controller import __main__ as shell
from lab.study.catalogue import EXPERIMENTS


def test_the_experiments_that_may_be_named_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert shell.run(["study", "--list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out.splitlines()[-1])["result"]
    assert list(listed) == [one.name for one in EXPERIMENTS]
    assert listed["residual-six"].endswith("(only if named)")
    assert not listed["residual"].endswith("(only if named)")
