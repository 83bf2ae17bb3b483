"""Whatever a user writes gives a result or a sentence within two seconds.

``SWARMSIM_MUTANTS=2000 python -m pytest tests/config/test_mutations.py -s`` tries that many faults.
"""

import os
import re
from collections import Counter
from collections.abc import Iterator

import pytest

from swarmsim.cli import main
from tests.config.mutations import Outcome, judge, make_configs, make_mutant

COUNT = int(os.environ.get("SWARMSIM_MUTANTS", "80"))
LIMIT_S = 2.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The working folder: a project with everything that is shipped; what takes long only once has been done."""
    path = tmp_path_factory.mktemp("mutants")
    make_configs(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        assert main(["check", "configs"]) == 0
        yield


def told(outcome: Outcome) -> str:
    mutant = outcome.mutant
    return f"seed {mutant.seed}, {mutant.path}, {mutant.what}: {outcome.result}, {outcome.time_s:.2f} s"


def test_no_fault_gives_a_traceback_or_takes_long(folder: None) -> None:
    outcomes = [judge(make_mutant(seed)) for seed in range(COUNT)]
    counts = Counter(outcome.result if outcome.told else "traceback" for outcome in outcomes)
    slowest = sorted(outcomes, key=lambda outcome: -outcome.time_s)[:5]
    print("\n", dict(counts), "slowest:", *map(told, slowest), sep="\n")
    # A site that has changed and is right is imported anew, which is more than a check.
    slow = [o for o in outcomes if o.time_s > LIMIT_S and not (o.result == "accepted" and "sites" in o.mutant.path)]
    assert not [told(outcome) for outcome in outcomes if not outcome.told or outcome in slow]
    assert counts["refused"] > 0.3 * COUNT  # the faults are faults
    assert counts["accepted"] > 0.02 * COUNT
    for outcome in outcomes:
        if outcome.result == "refused" and not outcome.mutant.overrides:
            assert re.search(r"\w+", outcome.message), told(outcome)
            assert max(map(len, outcome.message.splitlines())) < 5000, told(outcome)


def test_a_mutant_is_that_of_its_seed() -> None:
    assert [make_mutant(seed) for seed in range(20)] == [make_mutant(seed) for seed in range(20)]
    assert len({make_mutant(seed).content for seed in range(20)}) > 10


def test_a_bug_would_be_noticed(folder: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("swarmsim.cli.files.check_file", broken)
    assert any(not judge(make_mutant(seed)).told for seed in range(3))
