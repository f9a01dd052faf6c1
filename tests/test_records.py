"""Records: dataclasses to and from plain values."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from facts import raises
from numpy.typing import NDArray

from slviewer.errors import InputError
from slviewer.records.record import from_plain, to_plain


@dataclass(frozen=True, eq=False)
class Inner:
    weights: NDArray[np.float32] | None
    kind: Literal["a", "b"] = "a"

    def __post_init__(self) -> None:
        if self.weights is not None and self.weights.shape != (2,):
            raise InputError(f"{self.weights.shape} weights: give 2.")


@dataclass(frozen=True, eq=False)
class Outer:
    points: np.ndarray
    inner: tuple[Inner, ...]
    counts: Mapping[str, float]
    limit: float | None = None


PLAIN = {
    "points": [[1.0, float("nan")]],
    "inner": [{"weights": [1.0, 2.0], "kind": "b"}, {"weights": None, "kind": "a"}],
    "counts": {"x": 3.0},
    "limit": None,
}


def test_a_record_comes_back_with_its_types() -> None:
    read = from_plain(json.loads(json.dumps(PLAIN)) | {"unknown": 1}, Outer)
    assert (
        np.array_equal(read.points, [[1.0, np.nan]], equal_nan=True)
        and read.points.dtype == np.float64
    )
    weights = read.inner[0].weights
    assert weights is not None and weights.dtype == np.float32 and read.inner[1].weights is None
    assert json.dumps(to_plain(read)) == json.dumps(PLAIN)


def test_numpy_values_and_paths_become_plain() -> None:
    assert to_plain({"n": np.int64(3), "flag": np.True_, "path": Path("a") / "b"}) == {
        "n": 3, "flag": True, "path": str(Path("a") / "b"),
    }  # fmt: skip
    with raises(TypeError, "object"):
        to_plain({"what": object()})


@pytest.mark.parametrize(
    ("damage", "facts"),
    [
        ({"counts": {"x": None}}, ["counts"]),
        ({"points": [["a"]]}, ["points"]),
        ({"points": [[1.0], [1.0, 2.0]]}, ["points"]),
        ({"inner": [{"weights": None, "kind": "c"}]}, ["inner"]),
        ({"inner": [{"weights": [1.0], "kind": "a"}]}, ["1", "2"]),
    ],
)
def test_what_does_not_fit_is_named(damage: dict[str, object], facts: list[str]) -> None:
    with raises(InputError, *facts):
        from_plain(PLAIN | damage, Outer)
    with raises(InputError, "inner"):
        from_plain({"points": [[1.0]]}, Outer)
