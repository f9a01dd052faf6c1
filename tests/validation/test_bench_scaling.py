"""Growth of time with size, from measured seconds."""

import numpy as np
import pytest
from facts import missing_facts

from slviewer.simulation.plans import letter_plan
from slviewer.simulation.rig import letter
from slviewer.validation import bench_scaling


def test_the_exponent_of_the_growth_is_stated_beside_the_last_size(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sizes = iter((1.0, 2.0, 4.0))
    made = []

    def work(size: float) -> object:
        assert size == next(sizes)

        def run() -> float:
            made.append(np.ones(int(1e6 * size)))
            return size

        return run

    monkeypatch.setattr(bench_scaling, "median", lambda run, times, warm: 2.0 * run() ** 2)
    rows = bench_scaling._measure_growth(
        "something",
        (1.0, 2.0, 4.0),
        work,  # type: ignore[arg-type]
    )
    assert [row["ms"] for row in rows] == [2000.0, 8000.0, 32000.0]
    assert [row["MB"] > 7.9 * size for row, size in zip(rows, (1, 2, 4), strict=True)] == [True] * 3
    assert [row["note"] for row in rows[:2]] == ["", ""]
    assert missing_facts(rows[2]["note"], "2.00", "more than linear") == []


@pytest.mark.computes
@pytest.mark.slow
def test_pixels_captures_and_scans_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = letter(0.15)
    scene = letter_plan(rig, poses=1)["pose_01"]
    monkeypatch.setattr(bench_scaling, "MEGAPIXELS", (0.05, 0.1))
    monkeypatch.setattr(bench_scaling, "CAPTURES", (2, 4))
    monkeypatch.setattr(bench_scaling, "SCANS", (2, 3))
    rows = bench_scaling._time_pixels(rig, scene) + bench_scaling._time_captures(rig, scene)
    rows += bench_scaling._time_scans(rig)
    assert len(rows) == 6 and all(row["ms"] > 0.01 and row["MB"] > 0 for row in rows)
    assert all(missing_facts(row["note"], "linear") == [] for row in rows[1::2])
