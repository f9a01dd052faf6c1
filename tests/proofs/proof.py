"""The result of proving one claim: a table, the figures that must lie within bounds, and all of it
as JSON."""

import json
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar

from slviewer.evaluation.render import Row, render
from slviewer.pipeline.operation import Progress
from slviewer.records.record import to_plain

PROCESSES = 2
T = TypeVar("T")


@dataclass(frozen=True)
class BandCheck:
    """A figure ``what`` of a ``rig`` (or scan, or surface), and the band in which it must lie."""

    rig: str
    what: str
    value: float
    least: float
    most: float

    @property
    def holds(self) -> bool:
        """Whether the value is inside the band; False for NaN."""
        return self.least <= self.value <= self.most

    def text(self) -> str:
        """The figure and its band in one line."""
        band = (
            f"at most {self.most:g}" if self.least <= 0 else f"{self.least:.3g} to {self.most:.3g}"
        )
        return f"{self.rig}: {self.what} is {self.value:.4g}, wanted {band}"


@dataclass(frozen=True, eq=False)
class Proof:
    """``rows``: the printed table, with lines ``above`` and ``below``. ``record``: the values for
    JSON."""

    holds: bool
    scale: float
    rows: Sequence[Row]
    record: Mapping[str, Any] = field(default_factory=dict)
    above: Sequence[str] = ()
    below: Sequence[str] = ()

    def text(self) -> str:
        """Return the table with its lines."""
        return "\n".join([*self.above, render(self.rows), *self.below])

    def to_json(self) -> dict[str, Any]:
        """Return plain values; NaN becomes None."""
        text = json.dumps(
            {"scale": self.scale, "holds": self.holds, **self.record}, default=to_plain
        )
        constants = {"NaN": None, "Infinity": float("inf")}
        return dict(json.loads(text, parse_constant=constants.get))


def judge_all(
    judge: Callable[..., T], cases: Sequence[tuple[str, tuple[Any, ...]]], progress: Progress
) -> Iterator[T]:
    """Yield what ``judge`` returns for the arguments of each case, in their order, from processes
    of their own; ``cases``: what the progress calls each, and its arguments."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(PROCESSES, spawn) as pool:
        names, arguments = zip(*cases, strict=True)
        judged = pool.map(judge, *zip(*arguments, strict=True), chunksize=4)
        for k, (name, each) in enumerate(zip(names, judged, strict=True)):
            progress(k / len(cases), name)
            yield each


def prove_checks(
    checks: Sequence[BandCheck],
    scale: float,
    rows: Sequence[Row],
    record: Mapping[str, Any],
    above: Sequence[str] = (),
    below: Sequence[str] = (),
) -> Proof:
    """The proof that holds where all ``checks`` do; those that fail are listed at its end."""
    failed = [check.text() for check in checks if not check.holds]
    summary = f"{len(checks) - len(failed)} of {len(checks)} figures hold"
    figures = [{**vars(check), "holds": check.holds} for check in checks]
    return Proof(
        not failed, scale, rows, {"checks": figures, **record}, above, [*below, summary, *failed]
    )
