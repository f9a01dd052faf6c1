"""Where workers of a batch deliver: many into the same exports at once, some of which die on the
way."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from slviewer.operations.batch import export_folder, remove_leftovers

BATCH = "0a1b2c3d"
WORKERS, EACH = 4, 150


def test_workers_that_deliver_at_once_do_not_trip_each_other(tmp_path: Path) -> None:
    def worker(w: int) -> None:
        for k in range(EACH):
            with export_folder(str(tmp_path), BATCH) as made:
                (made / f"{w}_{k}.ply").write_bytes(bytes([w]))

    with ThreadPoolExecutor(WORKERS) as pool:
        list(pool.map(worker, range(WORKERS)))
    found = {path.name: path.read_bytes() for path in (tmp_path / "exports").iterdir()}
    assert found == {f"{w}_{k}.ply": bytes([w]) for w in range(WORKERS) for k in range(EACH)}


def test_two_attempts_at_one_piece_share_nothing(tmp_path: Path) -> None:
    """A worker that was taken for dead delivers late, while the retry delivers the same files."""
    names = [f"piece_{k}.ply" for k in range(20)]

    def attempt(number: int) -> None:
        for _ in range(10):
            with export_folder(str(tmp_path), BATCH) as made:
                for name in names:
                    (made / name).write_bytes(bytes([number]) * 50_000)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(attempt, (1, 2)))
    found = {path.name: path.read_bytes() for path in (tmp_path / "exports").iterdir()}
    assert sorted(found) == sorted(names), "nothing is left of either"
    assert all(content in (b"\1" * 50_000, b"\2" * 50_000) for content in found.values()), (
        "each file is of one attempt"
    )


def test_what_a_killed_worker_leaves_goes_with_its_batch_alone(tmp_path: Path) -> None:
    exports = tmp_path / "exports"
    exports.mkdir()
    for batch in (BATCH, "another"):
        (exports / f".batch-{batch}-12ab34cd-half.ply").write_bytes(b"ply")
    remove_leftovers(str(tmp_path), BATCH)
    (other,) = (tmp_path / "exports").iterdir()
    assert other.name.startswith(".batch-another")
