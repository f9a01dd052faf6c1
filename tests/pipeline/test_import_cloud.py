"""A cloud of another scanner is a scan of the session, which has no frames."""

from pathlib import Path

import numpy as np
import pytest

from slviewer.errors import InputError, UsageError
from slviewer.pipeline.accept import check
from slviewer.pipeline.edit import edit_scan
from slviewer.pipeline.export import export
from slviewer.pipeline.import_cloud import import_cloud
from slviewer.pipeline.measure import measure, relate
from slviewer.pipeline.merge import MergeSettings, merge
from slviewer.pipeline.mesh import mesh
from slviewer.pipeline.reconstruct import reconstruct, verify
from slviewer.pipeline.report import inspect
from slviewer.session.importers.clouds import read_cloud
from slviewer.session.store import Session
from slviewer.surface.meshing import MeshingPlan
from slviewer.surface.shapes import PointSet
from slviewer.surface.unorganised import estimate_normals, estimate_point_noise, fuse_points

CENTRE, RADIUS, NOISE = np.array([2.0, 3.0, 120.0]), 20.0, 0.03


def ball(seed: int = 0, count: int = 6000) -> tuple[np.ndarray, np.ndarray]:
    """Return noisy points (n, 3) mm all around a sphere, and its normals there."""
    rng = np.random.default_rng(seed)
    out = rng.normal(size=(count, 3))
    out /= np.linalg.norm(out, axis=1)[:, None]
    return CENTRE + (RADIUS + NOISE * rng.normal(size=(count, 1))) * out, out


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("clouds")
    np.savetxt(folder / "ball.xyz", ball()[0], "%.4f")
    np.savetxt(folder / "part one.xyz", ball(1)[0], "%.4f")
    warnings = list[str]()
    files = [folder / "ball.xyz", folder / "missing.ply", folder / "part one.xyz"]
    found = import_cloud(folder / "session", files, warn=warnings.append)
    assert list(found) == ["ball", "part_one"]
    assert len(warnings) == 1
    assert "missing.ply" in warnings[0]
    assert "ball.xyz in mm" in found.text()
    return folder / "session"


def test_imported_ball_is_measured_with_the_uncertainty_of_its_points(session: Path) -> None:
    found = measure(session, "ball", "sphere", ball=(*CENTRE.tolist(), RADIUS + 5))
    radius = found.only.quantities[0]
    assert radius.U is not None
    assert 0 < abs(radius.value - RADIUS) < radius.U < 0.01
    assert not radius.whole
    assert "imported cloud" in found.notes[0]
    measure(session, "part_one", "sphere", ball=(*CENTRE.tolist(), RADIUS + 5))
    with pytest.raises(InputError, match="one frame"):
        relate(session, "m1", "m2")


def test_what_needs_frames_says_that_it_was_imported(session: Path) -> None:
    with pytest.raises(InputError, match=r"Cannot reconstruct 'ball': it was imported as a cloud"):
        reconstruct(session, "ball")
    with pytest.raises(InputError, match=r"Cannot verify 'ball': it was imported as a cloud"):
        verify(session, ["ball"], "sphere")
    with pytest.raises(InputError, match=r"Cannot check 'ball': it was imported as a cloud"):
        check(session, "ball")
    with pytest.raises(InputError, match=r"Cannot texture 'ball': it was imported as a cloud"):
        mesh(session, ["ball"], texture=256)
    with Session.open(session) as store, pytest.raises(InputError, match="Cannot decode 'ball'"):
        _ = store.load_capture("ball").frames
    with pytest.raises(InputError, match="imported as a cloud"):
        edit_scan(session, "ball", part=(3, 4))


def test_imported_scan_is_listed_checked_and_replaced(session: Path, tmp_path: Path) -> None:
    assert "imported cloud" in inspect(session)
    assert "2 captures and" in inspect(session, check=True)
    np.savetxt(tmp_path / "ball.xyz", ball(2)[0] / 1000, "%.7f")
    with pytest.raises(InputError, match="--force"):
        import_cloud(session, [tmp_path / "ball.xyz"], unit="m")
    with Session.open(session) as store:
        before = store.load_capture("ball").hash
    found = import_cloud(session, [tmp_path / "ball.xyz"], unit="m", sigma_um=12.0, force=True)
    assert found.only.noise_mm == pytest.approx(0.012)
    with Session.open(session) as store:
        assert store.load_capture("ball").hash != before
        assert store.state_of("clouds/ball") == "fresh"


def test_survey_coordinates_and_scalars_are_exported_as_they_came(tmp_path: Path) -> None:
    """Clouds that are far from the origin share the origin that is subtracted, and a nearer one is
    said to be elsewhere."""
    place, session = np.array([694_123_456.0, 5_155_987_654.0, 85_000.0]), tmp_path / "session"
    points = [np.round(ball(seed)[0], 4) + place + (300.0 * seed, 0, 0) for seed in range(2)]
    time = np.arange(len(points[0])) + 1.7e9 + 0.25
    for name, each in zip("ab", points, strict=True):
        rows = np.column_stack([each, time])
        np.savetxt(
            tmp_path / f"{name}.csv", rows, "%.4f", ",", header="x,y,z,GPS time", comments=""
        )
    np.savetxt(tmp_path / "near.xyz", ball(2)[0], "%.4f")
    files = [tmp_path / name for name in ("a.csv", "b.csv", "near.xyz")]
    found = import_cloud(session, files)
    origins = [found[name].imported.origin_mm for name in ("a", "b", "near")]
    assert origins == [(694_123_000.0, 5_155_988_000.0, 85_000.0)] * 2 + [None]
    assert "export adds" in found.text()
    assert "place to them is not kept" in " ".join(found["near"].imported.notes)
    assert found["a"].imported.scalars == ("GPS_time",)
    for suffix in ("ply", "pcd", "csv"):
        export(session, "cloud", "b", out=tmp_path / f"o.{suffix}")
        (cloud,) = read_cloud(tmp_path / f"o.{suffix}")[1]
        assert np.abs(cloud.points - points[1]).max() < 1e-4
        assert np.array_equal(cloud.scalars["GPS_time"], time)
    words = export(session, "cloud", "b", out=tmp_path / "o.xyz").words
    assert "without GPS_time" in words


def test_a_merge_keeps_the_origin_and_says_what_it_does_not_hold(tmp_path: Path) -> None:
    place, session = np.array([694_123_456.0, 5_155_987_654.0, 85_000.0]), tmp_path / "session"
    u, v = np.meshgrid(*(np.linspace(-20, 20, 80),) * 2)
    bumps = 3 * np.sin(u / 4) + 2 * np.cos(v / 5) + u * v / 80
    points = np.stack([u, v, bumps], axis=-1).reshape(-1, 3) + place
    for seed, name in enumerate("ab"):
        noise = np.random.default_rng(seed).normal(0, 0.01, points.shape)
        rows = np.column_stack([points + noise, np.full(len(points), 21.5)])
        np.savetxt(tmp_path / f"{name}.csv", rows, "%.4f", ",", header="x,y,z,T", comments="")
    import_cloud(session, [tmp_path / "a.csv", tmp_path / "b.csv"])
    warnings = list[str]()
    merge.run(session, MergeSettings(["a", "b"], "a", start="identity"), warn=warnings.append)
    assert "holds no T" in " ".join(warnings)
    export(session, "merge", out=tmp_path / "m.ply")
    (merged,) = read_cloud(tmp_path / "m.ply")[1]
    assert np.abs(merged.points.mean(axis=0) - points.mean(axis=0)).max() < 0.5


def test_mesh_through_imported_points_is_closed(session: Path) -> None:
    topology = mesh(session, ["part_one"], plan=MeshingPlan(watertight=True)).meshed.topology
    assert topology.watertight
    assert topology.volume_mm3 == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)


def test_settings_that_name_nothing_are_refused() -> None:
    with pytest.raises(UsageError, match="no file"):
        import_cloud("session", [])
    with pytest.raises(UsageError, match="sigma"):
        import_cloud("session", ["a.xyz"], sigma_um=-1.0)


def test_noise_of_points_is_estimated_where_the_surface_bends() -> None:
    points, _ = ball(3)
    assert 0.9 * NOISE < estimate_point_noise(points) < 1.1 * NOISE
    exact = CENTRE + RADIUS * ball(3)[1]
    assert 0 < estimate_point_noise(exact) < 0.01 * NOISE


def test_normals_face_the_scanner_where_it_sees_the_points_and_outwards_elsewhere() -> None:
    points, out = ball(4)
    normals, is_seen = estimate_normals(points, np.zeros(3))
    assert not is_seen
    assert (np.sum(normals * out, axis=1) > 0.9).all()
    seen = np.sum(out * points, axis=1) < -20
    normals, is_seen = estimate_normals(points[seen], np.zeros(3))
    assert is_seen
    assert (np.sum(normals * out[seen], axis=1) > 0.9).mean() > 0.99


def test_fused_points_are_weighted_means_where_scans_overlap() -> None:
    """Of a coarse and a precise scan of one sphere the precise points remain, a little better."""
    rng = np.random.default_rng(5)
    out = ball(5, 20_000)[1]
    upper, lower = out[out[:, 2] > -0.3], out[out[:, 2] < 0.3]
    sets = {
        name: PointSet(
            RADIUS * side + sigma * rng.normal(size=(len(side), 1)) * side,
            side,
            None,
            np.full(len(side), sigma),
        )
        for name, side, sigma in (("a", upper, 0.02), ("b", lower, 0.04))
    }
    (a, by_a), (b, by_b) = fuse_points(sets)
    assert len(a) == len(upper)
    assert (b.points[:, 2] < -0.25 * RADIUS).all()
    assert a.sigma_mm is not None
    both = by_a == 2
    assert 0.25 < both.mean() < 0.5
    error = np.linalg.norm(a.points, axis=1) - RADIUS
    assert 0.85 < error[both].std() / a.sigma_mm[both].mean() < 1.15
    assert a.sigma_mm[both].mean() == pytest.approx(1 / np.hypot(1 / 0.02, 1 / 0.04), rel=1e-3)
    assert error[~both].std() > 1.05 * error[both].std()
    assert (by_b == 1).mean() > 0.9
