"""What the benchmark says of its floors and of absent peers; its figures are ratios, and no test's
business."""

import json
from functools import partial
from timeit import timeit

import numpy as np
import pytest
from facts import missing_facts

from slviewer.geometry.jit import run_rows
from slviewer.validation import bench_check
from slviewer.validation.bench import Benchmark, bench
from slviewer.validation.bench_rows import megabytes, missing, move_bytes, row, time_beside


@pytest.mark.slow
@pytest.mark.computes
def test_the_floor_reads_and_writes_every_byte() -> None:
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (5, 7, 9)).astype(np.uint8)
    numbers = rng.random((2, 7, 9)).astype(np.float32)
    grey, single = np.zeros((1, 7, 9), np.uint8), np.zeros((3, 7, 9), np.float32)
    triple = np.zeros((1, 7, 9, 3), np.float32)
    floor = partial(run_rows, move_bytes, 7, frames, numbers, grey, single, triple)
    seconds, least = time_beside(lambda: 0.0, partial(timeit, floor, number=1))
    assert 0 <= seconds < least
    np.testing.assert_array_equal(grey[0], np.bitwise_xor.reduce(frames))
    np.testing.assert_allclose(single, np.broadcast_to(numbers.sum(0), single.shape), rtol=1e-6)
    np.testing.assert_allclose(triple[0, ..., 2], numbers.sum(0), rtol=1e-6)


def test_the_table_and_its_json() -> None:
    frames = np.zeros((2, 500, 1000), np.uint8)
    table = Benchmark(
        [row("decode", 0.003, megabytes(frames), 0.002)], None, (missing("no-such-peer"),)
    )
    assert (
        missing_facts(table.text(), "decode", "no-such-peer", "pip install 'slviewer[bench]'") == []
    )
    stage = json.loads(json.dumps(table.to_json()))["stages"][0]
    assert stage["MB"] == 1.0 and abs(stage["ratio to floor"] - 1.5) < 1e-9
    assert missing("numpy") == ""


def test_check_names_stages_that_grew(monkeypatch: pytest.MonkeyPatch) -> None:
    times = {"steady": [1.9] * 9, "busy at first": [2.1] * 5 + [1.5] + [2.1] * 3}
    times["grown"] = [2.1] * 9
    stages = {name: (partial(next, iter(each)), lambda: 1.0) for name, each in times.items()}
    monkeypatch.setattr(bench_check, "_prepare_stages", lambda scale, folder: stages)
    monkeypatch.setattr(bench_check, "LIMITS", dict.fromkeys(times, 2.0))
    checked = bench(check=True)
    assert [each["holds"] for each in checked.rows] == ["yes", "yes", "no"]
    assert missing_facts(checked.failure, "grown") == []
    assert "steady" not in checked.failure and "busy" not in checked.failure


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.process
def test_no_stage_is_slower_than_its_limit() -> None:
    checked = bench(check=True)
    assert [each["stage"] for each in checked.rows] == list(bench_check.LIMITS)
    assert not checked.failure, checked.text()
