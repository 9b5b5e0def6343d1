"""Seeded mutations of valid files for every reader (see `tests.io.fuzz`)."""

from tests.io import fuzz

MUTATIONS = 200


def test_every_reader_returns_or_refuses(tmp_path):
    failures = {}
    for reader, outcome in fuzz.outcomes(fuzz.all_readers(tmp_path), MUTATIONS):
        assert outcome.counts["read"] + outcome.counts["refused"] > 0
        if outcome.failures:
            failures[reader.name] = outcome.failures
    assert not failures, (
        "repeat with python -m tests.io.fuzz --only NAME --first CASE --mutations 1 --verbose"
    )
