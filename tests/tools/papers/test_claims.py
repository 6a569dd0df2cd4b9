"""Every claim of a paper is measured: it holds, or fails as its table says. The bounds are written
there alone; the acceptance tests have what no table of claims says."""

from __future__ import annotations

import pytest

from ato_hil.tools.papers import names, part
from ato_hil.tools.papers.claims import Claim, evaluate

# Claims of these papers take seconds but for the laws that compile a loop of their own.
QUICK = {
    "cailc": ("adaptive", "the same, sharp gains"),
    "drac": ("TH2 beats a tuned PID",),
    "mtcc": ("SVL", "PID"),
}


def of_all_papers():
    for paper in names():
        for claim in part(paper, "claims").CLAIMS:
            slow = paper not in QUICK or claim.text.startswith(QUICK[paper])
            marks = [pytest.mark.long] if slow else []
            yield pytest.param(claim, id=f"{paper}: {claim.text}", marks=marks)


@pytest.mark.parametrize("claim", list(of_all_papers()))
def test_a_claim_is_as_its_table_says(claim: Claim) -> None:
    row = evaluate(claim)
    assert row.holds == row.expected, row
