"""A report names what it was made from, and its figures are computed again from the frames."""

import html
import shutil
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from copies import copy_session
from facts import missing_facts, raises

import slviewer as sl
from slviewer.errors import InputError
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.inspection.regions import Region
from slviewer.pipeline.certificate import (
    ReportCheck,
    _compare,
    certify_page,
    read_certificate,
    verify_report,
)
from slviewer.pipeline.inspect_parts import run_plan
from slviewer.pipeline.measure import load_surface, relate
from slviewer.pipeline.operation import Job
from slviewer.pipeline.report import report
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.records.inspection import Characteristic
from slviewer.report.page import CERTIFICATE, split_page
from slviewer.session.inspection_plan import Plan, PlanFeature, write_plan
from slviewer.session.store import Session
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.target.board import Board

pytestmark = pytest.mark.computes


@pytest.fixture(scope="module")
def certified(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A session with an imported calibration, measurements of a plane, and a sphere; and the report
    of it."""
    folder, rig = (
        tmp_path_factory.mktemp("certified") / "session",
        letter(0.15, local_distortion_px=0.0),
    )
    sequence = one_axis(p18(rig.projector.size), "x")
    plan = letter_plan(rig, Board.parse("circles:21x16:9"), 3)
    with Session.create(folder) as store:
        save_true_stereo(store, rig)
        for i, name in enumerate(("plane_01", "sphere_3")):
            frames = Renderer(rig, plan[name]).capture(sequence, i)
            store.save_capture(name, "scan", sequence, frames, source="simulated")
    return folder, measured_report(folder, "stereo")


@pytest.fixture(scope="module")
def calibrated(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The recorded session without splined, with measurements; and the report of it."""
    folder = copy_session(recorded / "session", tmp_path_factory.mktemp("calibrated") / "session")
    with Session.open(folder, write=True) as store:
        store.trash_result("calibration/splined")
    return folder, measured_report(folder, "pixelwise")


def measured_report(folder: Path, model: str) -> Path:
    """Scale a session's model, measure its plane_01, and write the report beside the session."""
    page = folder.parent / "report.html"
    with Session.open(folder, write=True) as store:
        inputs = store.input_hashes(f"calibration/{model}")
        applied = {"factor": 1.001, "U_ppm": 20.0, "certificate": "lab 7", "inputs": inputs}
        store.save_result(f"scale/{model}", applied, {})
        plane = load_surface(Job(store), "plane_01")
        u, v = (int(value) for value in np.argwhere(plane.measured).mean(axis=0)[::-1])
        sl.measure(store, "plane_01", "plane", ball=(*plane.points[v, u].tolist(), 20.0))
        sl.measure(store, "plane_01", "distance", at=(u - 20, v, u + 20, v))
        sl.measure(store, "plane_01", "section", at=(u - 20, v, u + 20, v))
        turned = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
        middle = turned @ plane.points[v, u + 30].astype(float)
        box = (*(middle - 12).tolist(), *(middle + 12).tolist())
        sl.measure(store, "plane_01", "plane", box=box, axes=turned.tolist())
        relate(store, "m1", "m4")
        place = Region.ball(plane.points[v, u].astype(float), 20.0)
        features = (PlanFeature("middle", "plane", place),)
        flatness = Characteristic("flatness", "flatness", ("middle",), upper=1.0)
        write_plan(Plan("plate", features, (flatness,)), folder.parent / "plan.toml")
        run_plan(store, folder.parent / "plan.toml", ["plane_01"])
        report(store, page)
    return page


def states(found: ReportCheck) -> dict[str, str]:
    return {check.what: check.state for check in found.checks}


@pytest.mark.parametrize(
    ("session", "expected"),
    [
        ("certified", {"calibration/stereo", "frames of sphere_3"}),
        pytest.param(
            "calibrated",
            {"calibration/stereo", "calibration/pixelwise", "frames of pose_01"},
            marks=pytest.mark.slow,  # everything is calibrated anew
        ),
    ],
)
def test_the_figures_of_a_report_follow_from_the_frames(
    request: pytest.FixtureRequest, session: str, expected: set[str]
) -> None:
    folder, page = request.getfixturevalue(session)
    before = sorted(path.name for path in folder.rglob("*"))
    found = verify_report(folder, page)
    assert not found.failure, found.text()
    assert set(states(found).values()) == {"same"}, found.text()
    assert expected | {"page", "measurements/m1", "measurements/m5", "inspection/1"} <= set(
        states(found)
    )
    assert sorted(path.name for path in folder.rglob("*")) == before
    certificate = read_certificate(page)[1]
    assert all(
        len(c.frames) in (26, 52) and len(set(c.frames)) > 20 for c in certificate.captures.values()
    )
    assert "verify-report" in page.read_text() and "<script" not in page.read_text()


def test_a_number_changed_in_the_page_is_found(
    certified: tuple[Path, Path], tmp_path: Path
) -> None:
    folder, page = certified
    text = page.read_text()
    distance = read_certificate(page)[1].figures["measurements/m2"]["distance, mm"]
    shown = f"{distance:.4f}"[:-1]
    assert shown in text
    changed = tmp_path / "changed.html"
    changed.write_text(text.replace(shown, "99.999", 1))
    emptied = shutil.copytree(folder, tmp_path / "session")
    with Session.open(emptied, write=True) as store:
        store.exchange({"sphere_3": None})  # nothing is computed again then
    found = verify_report(emptied, changed)
    assert states(found)["page"] == "differs" and "page" in found.failure


def test_a_figure_forged_with_its_digest_does_not_follow_from_the_frames(
    certified: tuple[Path, Path], tmp_path: Path
) -> None:
    folder, page = certified
    text, certificate = read_certificate(page)
    figures = {name: dict(values) for name, values in certificate.figures.items()}
    figures["measurements/m2"]["distance, mm"] *= 1.01
    forged = certify_page(msgspec.structs.replace(certificate, figures=figures), certificate.page)
    before, _, after = split_page(text, CERTIFICATE)
    (tmp_path / "forged.html").write_text(before + html.escape(forged).join(CERTIFICATE) + after)
    found = verify_report(folder, tmp_path / "forged.html")
    assert [check.what for check in found.checks if check.state == "differs"] == ["measurements/m2"]
    assert (
        not missing_facts(found.text(), "measurements/m2", "distance, mm")
        and "measurements/m2" in found.failure
    )


def test_other_frames_are_found(
    certified: tuple[Path, Path], tmp_path: Path, run: Callable[..., tuple]
) -> None:
    folder = shutil.copytree(certified[0], tmp_path / "session")
    with Session.open(folder, write=True) as store:
        capture = store.load_capture("plane_01")
        frames = capture.frames.copy()
        frames[7, 50, 50] ^= 1
        store.save_capture(
            "plane_01", capture.role, capture.sequence, frames, source="changed", force=True
        )
        store.exchange({"sphere_3": None})
    status, out, error = run("verify-report", folder, certified[1])
    assert status == 1 and not missing_facts(error, "frames of plane_01", "frames of sphere_3")
    assert not missing_facts(out, "frames of plane_01", "frame 8", "frames of sphere_3")


@pytest.mark.parametrize(
    ("given", "made", "state"),
    [
        (534, 533, "same"),  # a value at its limit, rounded otherwise
        (534, 530, "differs"),
        (8, 7, "differs"),
        (8, 8, "same"),
        (0.034, 0.0341, "differs"),
        (0.034, 0.03401, "same"),
    ],
)
def test_counts_of_many_may_differ_by_one(given: float, made: float, state: str) -> None:
    assert _compare("verify/1", {"points": given}, {"points": made}, {}).state == state


def test_pages_without_a_certificate_are_refused(
    certified: tuple[Path, Path], tmp_path: Path
) -> None:
    page = tmp_path / "page.html"
    for content, reason in (
        ("<html></html>", "no certificate"),
        ('<template id="certificate">{"schema": 1</template>', "damaged"),
        ('<template id="certificate">{"schema": "x"}</template>', "damaged"),
        (certified[1].read_text().replace("&quot;frames&quot;", "&quot;other&quot;", 1), "damaged"),
        ('<template id="certificate">' * 40_000, "no certificate"),
    ):
        page.write_text(content)
        with raises(InputError, page.name, reason):
            verify_report(certified[0], page)
