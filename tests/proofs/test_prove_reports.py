"""Reported situations give the right value, or a refusal whose remedy leads to it."""

from pathlib import Path

import pytest

from tests.proofs.reports import CASES, rebuild_report


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("reports")


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_report_gives_the_right_value_or_a_remedy_that_does(name: str, shared: Path) -> None:
    outcome = rebuild_report(name, shared)
    assert outcome.holds, f"measured {outcome.measured}, true {outcome.truth}"
