"""What a session's report is written with: the details of its title page, and pictures of the
part."""

import base64
import html
import io
import re
from pathlib import Path

import numpy as np
import pytest
from clocks import HANG_S
from facts import raises
from PIL import Image

from slviewer.errors import DamagedError, InputError, UsageError
from slviewer.fringe.presets import phase_steps
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.operation import save_record
from slviewer.pipeline.report import report
from slviewer.records.merge import Merge, Reconstruction
from slviewer.records.verification import ModelFit, Verification
from slviewer.report.page import CERTIFICATE, split_page
from slviewer.report.surfaces import draw_photo
from slviewer.session.ply import write_ply
from slviewer.session.report_details import ReportDetails, encode_logo
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator

EVIL = "<script>alert(1)</script></style>"
H, W = 30, 40


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """Scans of a vase from two sides and of a plate that was verified, all with clouds."""
    folder = tmp_path / "session"
    sequence = PatternSequence((96, 64), tuple(phase_steps("x", 4, 16.0)))
    v, u = np.mgrid[0:H, 0:W].astype(np.float32)
    points = np.stack([u - W / 2, v - H / 2, 500 - 0.1 * u], axis=-1)
    points[:, :10] = np.nan
    arrays = {"points": points, "sigma_z": np.full((H, W), 0.1, np.float32)}
    arrays["texture"] = np.full((H, W), 200, np.uint8)
    with Session.create(folder) as store:
        for name in ("plate", "vase", "vase_2"):
            frames = np.random.default_rng(len(name)).integers(0, 255, (4, H, W), np.uint8)
            store.save_capture(name, "scan", sequence, frames)
            inputs, points_count = store.input_hashes(name), int(np.isfinite(points[..., 2]).sum())
            record = Reconstruction(model="stereo", points=points_count, inputs=inputs)
            save_record(store, name, record, arrays)
        fits = {"stereo": ModelFit(9, 0, 0.1)}
        known = Verification(shape="plane", models=fits, inputs=store.input_hashes("plate"))
        save_record(store, "plate", known, {"error_stereo": np.zeros((H, W), np.float32)})
        store.decide("names", {"vase": "Vase, <b>front</b>"})
    return folder


def written(session: Path, **details: object) -> str:
    report(session, session / "report.html", **details)
    return split_page((session / "report.html").read_text(), CERTIFICATE)[0]


def pictures(page: str) -> list[str]:
    before_results = page.split('class="wide body"')[0]
    return [
        html.unescape(each) for each in re.findall("<figcaption>(.*)</figcaption>", before_results)
    ]


def test_details_are_remembered_and_shown_as_typed(session: Path, tmp_path: Path) -> None:
    logo = tmp_path / "logo.png"
    Image.new("RGB", (2000, 500), "red").save(logo)
    page = written(
        session, part="Vase  7", customer=EVIL, operator="A. B.", temperature=20.5, logo=str(logo)
    )
    (shown,) = re.findall('class="logo" src="data:image/webp;base64,([^"]*)"', page)
    with Image.open(io.BytesIO(base64.b64decode(shown))) as image:
        assert image.size == (480, 120)
    for again in (page, written(session)):
        assert "<h1>Vase 7</h1>" in again and "20.5 °C" in again and "A. B." in again
        assert html.escape(EVIL) in again and EVIL not in again and shown in again
    page = written(session, part="", logo="", order="PO 1")
    assert "<h1>session</h1>" in page and 'class="logo"' not in page and "PO 1" in page
    with Session.open(session) as store:
        assert store.report_details() == ReportDetails(
            customer=EVIL, order="PO 1", operator="A. B.", temperature_c=20.5
        )


def test_impossible_details_are_refused_and_damaged_ones_named(
    session: Path, tmp_path: Path
) -> None:
    for wrong in ({"part": "x" * 201}, {"customer": "a\u202eb"}):
        with raises(InputError):
            written(session, **wrong)
    with raises(UsageError, "temperature", "200"):
        written(session, temperature=900.0)
    (tmp_path / "logo.svg").write_text("<svg/>")
    with raises(InputError, "logo.svg", "PNG"):
        written(session, logo=str(tmp_path / "logo.svg"))
    with raises(InputError, "x.png"):
        encode_logo("x.png", b"\x89PNG\r\n\x1a\n broken")
    with Session.open(session, write=True) as store:
        store.decide("report", {"part": "p", "logo": '"><script>'})
        with pytest.raises(DamagedError):
            store.decision("report")
        assert store.report_details() == ReportDetails() and store.decision_faults()
    assert "<script" not in written(session)


def test_the_title_page_shows_the_part_and_not_what_was_verified(session: Path) -> None:
    page = written(session)
    seen, surface = pictures(page)
    assert "Vase, <b>front</b>" in seen and "Vase, <b>front</b>" in surface and "900" in surface
    assert "2 scans" in page and "1 known shape" in page
    with Session.open(session, write=True) as store:
        made = Merge(
            reference="vase_2", scans=["vase", "vase_2"], pairs={}, points=3, ply="merged_1.ply",
            inputs=store.input_hashes("vase", "vase_2"),
        )  # fmt: skip
        save_record(store, "1", made, {})
        write_ply(store.exports / "merged_1.ply", np.eye(3, dtype=np.float32))
    seen, surface = pictures(written(session))
    assert "vase_2" in seen and "2 scans" in surface and "3 points" in surface
    (session / "exports" / "merged_1.ply").unlink()
    assert "vase_2" in pictures(written(session))[1]


def test_the_wizard_remembers_the_title_page(tmp_path: Path) -> None:
    image = io.BytesIO()
    Image.new("RGBA", (60, 20)).save(image, "PNG")
    with Operator(tmp_path / "session") as operator:
        assert operator.set_report_details(part="Vase", temperature_c=-2.5)
        assert operator.upload_logo("logo.png", image.getvalue())
        assert not operator.upload_logo("logo.png", b"<svg/>")
        assert not operator.set_report_details(customer="x" * 201)
        assert operator.export("report")
        operator.wait_until_idle(HANG_S)
        details = operator.snapshot().content.report_details
        page = next(operator.snapshot().content.folder.glob("exports/*.html")).read_text()
    assert (details.part, details.temperature_c, details.customer) == ("Vase", -2.5, "")
    assert details.logo and details.logo in page and "−2.5 °C" in page


def test_the_photo_is_cut_to_the_part() -> None:
    texture, points = np.zeros((60, 200, 3), np.uint8), np.full((60, 200, 3), np.nan)
    texture[20:40, 150:180] = 255
    points[20:40, 150:180] = 1.0
    picture = draw_photo("part", texture, points).pixels
    assert picture.shape[1] / picture.shape[0] == pytest.approx(4 / 3)
    assert picture.mean() > 150  # most of it
    assert draw_photo("part", texture[..., 0], np.full_like(points, np.nan)).pixels.shape[2] == 3
