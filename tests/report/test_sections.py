"""Whole reports from made-up results: what wins shows, what loses shows as plainly, and the Letter
stands beside it."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts
from made_up import MODELS, planes, reproduction_data, session_data, spheres
from playwright.sync_api import Browser

from slviewer.calibration.stereo import StereoModel
from slviewer.pipeline.accept import gather_results
from slviewer.pipeline.operation import read_record
from slviewer.records.acceptance import (
    AcceptanceTest,
    Decision,
    Drift,
    HeldOutPose,
    ModelComparison,
)
from slviewer.records.calibration import ModelCalibration, SplinedFit, VolumeSigma
from slviewer.records.inspection import (
    Characteristic,
    CharacteristicResult,
    Inspection,
    PartResult,
)
from slviewer.records.merge import DepthCheck, Merge
from slviewer.records.record import Cell, Table, better_worse, compare_errors
from slviewer.records.verdict import Finding, Verdict
from slviewer.records.verification import ModelFit, Verification
from slviewer.report.page import Figure, PageNotice, Section, write_page
from slviewer.report.reproduction import (
    inside_ratio,
    length_table,
    radius_table,
    reproduction_headlines,
    reproduction_sections,
    reproduction_title,
    shape_table,
)
from slviewer.report.session import (
    CalibrationFigures,
    RecordsView,
    make_title_page,
    session_headlines,
    session_sections,
    session_title,
)

pytestmark = pytest.mark.computes

WIDTH = 240
WIDTH_WANTED = Characteristic("width", "distance", ("a", "b"), upper=2.0)


def texts(section: Section) -> str:
    words = [section.title, *section.paragraphs]
    for item in section.items:
        if isinstance(item, Table):
            lines = item.format([*item.rows, *item.footer])
            words += [item.caption, *item.notes, *(text for line in lines for _, text, _ in line)]
        else:
            words.append(item.text if isinstance(item, PageNotice) else item.caption)
    return "\n".join(words)


def by_title(table: Table, name: str, model: str) -> dict[tuple[str, str], tuple[str, str]]:
    """Text and mark of each cell of the row of a capture and model."""
    (row,) = (row for row in table.rows if table.values(row[:2]) == [name, model])
    return {(c.group, c.title): (text, mark) for c, text, mark in table.format([row])[0]}


@pytest.fixture(scope="module")
def reproduction() -> list[Section]:
    return reproduction_sections(reproduction_data(WIDTH))


@pytest.fixture(scope="module")
def tables() -> list[Section]:
    """The reproduction's sections without figures of maps and planes, which take most of the
    time."""
    data = dataclasses.replace(reproduction_data(WIDTH), error_maps={}, plane_outlines={})
    return reproduction_sections(dataclasses.replace(data, pixel_curve=None))


@pytest.mark.slow
def test_the_reproduction_is_one_self_contained_file(
    tmp_path: Path, reproduction: list[Section]
) -> None:
    data = reproduction_data(WIDTH)
    path = tmp_path / "report.html"
    write_page(path, *reproduction_title(data), reproduction_headlines(data), reproduction)
    page = path.read_text(encoding="utf-8")
    assert set(re.findall(r'src="([^:"]*):', page)) == {"data"}
    assert len(page) < 6e6
    text = re.sub(r"base64,[^\"]*", "", page)  # the letters of an image may happen to be any word
    assert "http" not in text.replace("http-equiv", "") and "<script" not in text
    assert "Quick run" in text and "nan" not in text.lower()


@pytest.mark.slow
def test_every_experiment_shows_its_figures(reproduction: list[Section]) -> None:
    figures = [sum(isinstance(item, Figure) for item in section.items) for section in reproduction]
    # curves and RMS maps; bars, three poses and the planes in space; six spheres; three clouds and
    # the merged one
    assert figures == [2, 5, 6, 2]
    alts = " ".join(
        item.alt for section in reproduction for item in section.items if isinstance(item, Figure)
    )
    for word in (
        "pixel (500, 500)",
        "plane_01",
        "plane_03",
        "plane_08",
        "sphere_6",
        "object_r3",
        "merged",
    ):
        assert word in alts


@pytest.mark.slow
def test_the_letters_own_figures_stand_beside_ours(tables: list[Section]) -> None:
    words = "\n".join(texts(section) for section in tables)
    letter = (0.253, 0.141, 0.237, 0.184, 0.087, "3.59 × better", 98.44, 0.26, 0.25, "1,642,179")
    assert missing_facts(words, *letter) == []


@pytest.mark.slow
def test_where_pixelwise_loses_it_is_said(tables: list[Section]) -> None:
    planes = tables[1]
    assert any(
        isinstance(i, PageNotice) and i.kind == "warning" and "plane_01" in i.text
        for i in planes.items
    )
    table = next(i for i in planes.items if isinstance(i, Table))
    first, third = ({m: by_title(table, f"plane_0{i}", m) for m in MODELS} for i in (1, 3))
    assert first["pixelwise"]["", "RMS"] == ("0.219", "worse")
    assert first["stereo"]["", "RMS"] == ("0.134", "better")
    assert first["pixelwise"]["", "against stereo"] == ("1.63 × worse", "worse")
    assert third["pixelwise"]["", "RMS"] == ("0.076", "better")
    assert third["stereo"]["", "RMS"] == ("0.198", "")
    assert third["pixelwise"]["", "noise floor"] == ("0.036", "")
    assert by_title(table, "plane_08", "pixelwise")["", "against stereo"] == ("equal", "")


def test_the_ratio_counts_the_planes_inside() -> None:
    ratio, count = inside_ratio(planes())
    inside = ("plane_03", "plane_04", "plane_09", "plane_10")
    ours = [np.mean([planes()[name].rms_mm[m] for name in inside]) for m in MODELS]
    assert count == 4 and ratio == pytest.approx(ours[0] / ours[1])
    assert np.isnan(inside_ratio({})[0])


def test_headlines_name_both_and_mark_the_loser() -> None:
    data = reproduction_data(WIDTH)
    assert [h.mark for h in reproduction_headlines(data)] == ["better"] * 4
    assert "0.270 → 0.174 mm" in reproduction_headlines(data)[0].value
    worse = dataclasses.replace(
        data, spacings_mm={"a": (100.0, {"stereo": 100.1, "pixelwise": 100.4})}
    )
    assert reproduction_headlines(worse)[3].mark == "worse"


def test_an_empty_reproduction_still_makes_a_page() -> None:
    data = dataclasses.replace(
        reproduction_data(WIDTH),
        planes={},
        spheres={},
        spacings_mm={},
        pixel_curve=None,
        error_maps={},
        plane_outlines={},
        merge=None,
        clouds={},
        fused=None,
        stereo=dataclasses.replace(
            session_data(WIDTH).calibration.stereo,
            reprojection_rms_px={},
            excluded={"pose_02": "board not found"},
        ),
    )
    sections = reproduction_sections(data)
    assert len(sections) == 4 and len(reproduction_headlines(data)) == 2
    assert missing_facts(texts(sections[0]), "pose_02", "board not found") == []


def test_missing_values_are_dashes_not_winners() -> None:
    fits = {"stereo": ModelFit(9, 0, 0.1), "pixelwise": ModelFit(9, 0, None)}
    table = shape_table({"p": Verification(shape="plane", models=fits)}, "t")
    cells = by_title(table, "p", "pixelwise")
    assert cells["", "RMS"] == ("–", "muted") and ("", "against stereo") not in cells
    assert by_title(table, "p", "stereo")["", "RMS"] == ("0.100", "better")
    assert not table.footer and ("the Letter's rig", "RMS") not in cells


def test_verdicts() -> None:
    assert compare_errors(0.1, 0.25) == Cell("2.50 × better", "better")
    assert compare_errors(-0.25, 0.1) == Cell("2.50 × worse", "worse")
    assert compare_errors(0.100, 0.101) == Cell("equal") and better_worse(0.100, 0.101) == ""


def test_spheres_are_judged_by_their_radius_and_spacing() -> None:
    table = radius_table(spheres(), "t")
    assert by_title(table, "sphere_1", "stereo")["", "error"] == ("−0.090", "")
    row = by_title(table, "sphere_1", "pixelwise")
    assert row["", "error"] == ("+0.080", "better") and row["", "known"][0] == "98.000"
    assert row["the Letter's rig", "measured"][0] == "98.01"
    lengths = {"a to b": (150.0, {"stereo": 150.5, "pixelwise": 149.9})}
    spacing = by_title(length_table(lengths, "t"), "a to b", "pixelwise")
    assert spacing["", "error"] == ("−0.100", "better")
    assert spacing["", "against stereo"] == ("5.00 × better", "better")


def test_a_sessions_report(tmp_path: Path) -> None:
    data = session_data(WIDTH)
    sections = session_sections(data)
    titles = [section.title for section in sections]
    assert titles == [
        "Warnings", "Verification", "Reprojection", "Parameters", "Pixel-wise model",
        "Method and terms", "Captures",
    ]  # fmt: skip
    assert [section.is_annex for section in sections] == [False] + [True] * 6
    words = "\n".join(texts(section) for section in sections)
    facts = (
        "12 of 336 circles",
        "the board slipped",
        "pose_03",
        "pose_04",
        "20 %",
        "pose_14",
        "179.47 mm",
    )
    assert missing_facts(words, *facts) == []
    path = tmp_path / "report.html"
    title, counts = session_title(data)
    assert missing_facts(counts, "23 target poses", "1 scan") == []
    write_page(path, title, counts, session_headlines(data), sections)
    page = path.read_text(encoding="utf-8")
    assert "&lt;script&gt;" in page and "<script" not in page and "<b>" not in page
    assert set(re.findall(r'src="([^:"]*):', page)) == {"data"}


def test_a_session_with_nothing_in_it() -> None:
    data = dataclasses.replace(
        session_data(WIDTH), captures=[], calibration=None, pixel_fits={}, records=(), warnings=()
    )
    method, section = session_sections(data)
    assert "not recorded" in texts(method) and make_title_page(data).verdict == "not judged"
    assert missing_facts(texts(section), "captures") == [] and session_headlines(data) == []


def test_results_come_first_and_all_limits_decide() -> None:
    def inspected(*decisions: Decision) -> Inspection:
        parts = tuple(
            PartResult(f"part_{k}", (CharacteristicResult("width", 1.0, 0.1, each),))
            for k, each in enumerate(decisions)
        )
        return Inspection(plan="plate", characteristic=(WIDTH_WANTED,), parts=parts)

    def judged(verdict: Verdict | None, *decisions: Decision) -> tuple[str, str]:
        views = [*data.records, RecordsView(Inspection, {"1": inspected(*decisions)})]
        page = make_title_page(dataclasses.replace(data, records=views, verdict=verdict))
        return page.verdict, page.kind

    data = dataclasses.replace(session_data(WIDTH), calibration=None, pixel_fits={})
    assert judged(None, "pass", "pass") == ("pass", "good")
    assert judged(None, "pass", "fail", "undecided") == ("fail", "bad")
    assert judged(None, "pass", "undecided") == ("undecided", "warning")
    faults = {
        level: Verdict.of([Finding("outlier", level, "a pose moved", "repeat it")])
        for level in ("doubtful", "rejected")
    }
    assert judged(faults["doubtful"], "fail")[0] == "fail"
    assert judged(faults["rejected"], "pass")[0] == "undecided"
    views = [*data.records, RecordsView(Inspection, {"1": inspected("pass")})]
    sections = session_sections(dataclasses.replace(data, records=views))
    assert [section.title for section in sections if not section.is_annex] == [
        "Warnings", "Inspection"
    ]  # fmt: skip


def test_a_customers_report_is_short_and_hides_no_doubt(tmp_path: Path, browser: Browser) -> None:
    data, part = (
        session_data(WIDTH),
        PartResult("part_1", (CharacteristicResult("width", 1, 0.1, "pass"),)),
    )
    inspected = Inspection(plan="plate", characteristic=(WIDTH_WANTED,), parts=(part,))
    depths = {"b": DepthCheck((500, 600), 0.3)}
    merged = Merge(reference="a", scans=["a", "b"], pairs={}, points=9, ply="m.ply", depths=depths)
    views = [
        *data.records,
        RecordsView(Inspection, {"1": inspected}),
        RecordsView(Merge, {"1": merged}),
    ]
    data = dataclasses.replace(data, records=views)
    pages = {}
    for is_full in (False, True):
        sections = session_sections(data, is_full=is_full)
        titles = [section.title for section in sections]
        warned = "Merges, 1: " in texts(sections[0]) and "outside the calibrated" in texts(
            sections[0]
        )
        left_out = {"Verification", "Merges", "Reprojection", "Parameters", "Captures"}
        assert warned is not is_full and (
            left_out & set(titles) == (left_out if is_full else set())
        )
        assert titles[:2] == ["Warnings", "Inspection"] and "Method and terms" in titles
        path = tmp_path / f"{is_full}.html"
        write_page(
            path, "Plate", "", session_headlines(data), sections, title_page=make_title_page(data)
        )
        page = browser.new_page()
        page.goto(path.as_uri())
        pages[is_full] = len(re.findall(rb"/Type\s*/Page\b", page.pdf()))
        page.close()
    assert 2 <= pages[False] <= 4 < pages[True]


def test_the_title_page_counts_scans_of_the_part_alone() -> None:
    data = session_data(WIDTH)
    plate = dataclasses.replace(data.captures[-1], state="known shape")
    counted = dataclasses.replace(data, captures=[*data.captures, plate])
    assert missing_facts(session_title(counted)[1], "1 scan", "1 known shape", 23) == []
    bare = dataclasses.replace(data, model="stereo")
    assert {h.label: h.value for h in session_headlines(bare)} == {
        "RMS deviation of a flat plate": "0.166 mm"
    }


def test_a_calibration_made_elsewhere() -> None:
    data = session_data(WIDTH)
    assert data.calibration is not None
    made_elsewhere = StereoModel.from_rig(data.calibration.stereo.rig)
    bare = CalibrationFigures(made_elsewhere, made_elsewhere.reprojection)
    sections = session_sections(
        dataclasses.replace(data, calibration=bare, records=(), pixel_fits={})
    )
    reprojection = next(each for each in sections if each.title == "Reprojection")
    assert missing_facts(texts(reprojection), "elsewhere") == []


@pytest.mark.slow
def test_how_good_a_calibration_is() -> None:
    verdict = Verdict.of(
        [
            Finding(
                "empty-corner",
                "doubtful",
                "no pose reached the upper left corner",
                "fill it in two more poses",
            ),
            Finding("outlier", "note", "pose_07 is left out", ""),
        ]
    )
    held = {"stereo": 0.2, "splined": 0.02}
    measured = {
        m: {"pose_01": HeldOutPose(mm, mm, 100 * mm, mm, mm, 900, 550.0)} for m, mm in held.items()
    }
    compared = gather_results(measured, (("pose_01",),), {})
    splined = SplinedFit(
        steps=6,
        residuals_over_noise={"x": 1.0, "y": 1.1},
        noise_px={"camera": 0.01, "x": 0.011, "y": 0.012},
        local_distortion_rms_px={"camera": 0.1, "projector": 0.12},
        board_height_mm=(-0.02, 0.08),
        board_offsets_rms_mm=0.01,
        cells_lit={"camera": 0.98, "projector": 0.6},
        sigma_volume_mm=VolumeSigma(0.01, 0.03, 0.7, (399.0, 0.0, 794.0), 0.9, (426.0, 794.0), "x"),
        excluded={"pose_09": "contradicts the other poses"},
    )
    sides = {"within_95_mm": (-0.034, -0.026), "within_997_mm": (-0.036, -0.024)}
    figure = {
        "property": "sphere spacing",
        "error_mm": -0.03,
        "U_mm": 0.004,
        "position": "left",
        **sides,
    }
    found = {
        "artefact": {"name": "bar <1>", "certificate": "lab 7"},
        "model": "splined",
        "positions": [
            {
                "position": "left",
                "capture": "a",
                "figures": [figure],
                "rms_mm": [0.1],
                "floor_mm": [0.1],
                "points": 9,
            },
        ],
        "judgements": [
            {
                "property": "sphere spacing",
                "worst": figure,
                "limit_mm": 0.05,
                "decision": "undecided",
            }
        ],
        "scale": {"ppm": -300.0, "u_ppm": 20.0, "length_mm": 100.0, "positions": 2},
        "decision": "undecided",
        "lacks": ["2 of 7 positions were measured"],
        "scale_factor": 1.0,
        "scale_applied": 1.0003,
        "repeatability": {
            "captures": 10,
            "pixels": 9,
            "sigma_mm": 0.02,
            "sigma_95_mm": 0.03,
            "predicted_mm": 0.021,
            "wandering_mm": 0.001,
        },
        "budget": {
            "length_mm": 100.0,
            "U_mm": 0.03,
            "unknown": ["drift"],
            "contributions": [{"source": "drift", "u_mm": None, "kind": "B", "how": "no check"}],
        },
    }
    three = (0.0, 0.1, 0.0)
    drift = Drift(
        capture="plane_01", axes=("x",), verdict="recalibrate",
        reasons=("the board seems too large",), turn_mrad=three,
        turn_sigma_mrad=three, shift_mm=three, shift_sigma_mm=three, baseline_mm=0.0,
        baseline_sigma_mm=0.1,
        scale_ppm=420.0, scale_sigma_ppm=66.0, across_px=None, across_sigma_px=None,
        misfit_px=0.02, chance=0.01,
        seen_alone=(0.1,) * 6, unseen=(), time="2026-11-22T10:00:00+00:00",
    )  # fmt: skip
    balls = {
        name: Verification(
            shape="sphere",
            models={
                m: ModelFit(9, 0, 0.1, centre_mm=(x, 0.0, 500.0))
                for m, x in (("stereo", a), ("splined", b))
            },
        )
        for name, a, b in (("a", 0.0, 0.0), ("b", 60.6, 60.5))
    }
    data = dataclasses.replace(
        session_data(WIDTH),
        verdict=verdict,
        model="stereo",
        recommended="splined",
        scales={"splined": "scale corrected by +300 ppm"},
        records=[
            RecordsView(
                AcceptanceTest,
                {"1": read_record(AcceptanceTest, {"accepted": found, "time": "2026-11-21"})},
            ),
            RecordsView(ModelCalibration, {"splined": ModelCalibration(fit=splined)}),
            RecordsView(Drift, {"1": drift}),
            RecordsView(ModelComparison, {"1": compared}),
            RecordsView(Verification, balls),
        ],
    )
    assert [each.value for each in session_headlines(data)] == ["undecided", "doubtful"]
    words = "\n".join(texts(section) for section in session_sections(data))
    facts = (
        "fill it in two more poses",
        "splined",
        "+300 ppm",
        "0.0200",
        "0.100 mm",
        "pose_09",
        "contradicts the other poses",
        "UNDECIDED",
        "−300 ppm ± 40 ppm",
        "k = 2",
        "drift",
        "10 captures",
        "plane_01",
        "recalibrate",
        "the board seems too large",
        "60.500",
    )
    assert missing_facts(words, *facts) == []
