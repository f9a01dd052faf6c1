"""The parts of the step Measure that need no browser: tools, drawings in space, words, cursors."""

import re

import numpy as np
import pytest
from facts import missing_facts

from slviewer.gui.colouring import paint_points, surface_values
from slviewer.gui.measure_list import (
    cursor_html,
    cursor_points,
    deviation_figure,
    drawn,
    label,
    lifted,
    measurement_html,
    measurements_table,
)
from slviewer.gui.steps.measure import COMPARE, FIT, PICK, Tool
from slviewer.inspection.features import Feature
from slviewer.inspection.regions import Region
from slviewer.inspection.section import CutPlane
from slviewer.pipeline.measure import MeasuredSurface
from slviewer.pipeline.operation import Stored
from slviewer.records.measurement import DECIDED, Measurement, Quantity, list_quantities
from slviewer.records.record import from_plain, to_plain
from slviewer.report.surfaces import section_plot
from slviewer.wizard.result_views import place_at

CENTRE = np.array([10.0, 20.0, 500.0])
TOP = CENTRE - np.array([0.0, 0.0, 30.0])


def made(
    what: str, quantities: list[Quantity], stale: bool = False, **fields: object
) -> Stored[Measurement]:
    fields = {"quantities": quantities, "source": "scan_01", "model": "stereo", **fields}
    return Stored(
        f"m_{what}",
        f"<b>{what}</b>",
        from_plain(to_plain({"what": what, **fields}), Measurement),
        stale,
    )


SPHERE = made(
    "sphere",
    [Quantity("radius", 25.0, "mm", 0.01, whole=False)],
    feature=Feature("sphere", CENTRE, None, 25.0),
    warnings=["it is rough"],
)
POINT = made("point", [Quantity("x", -0.00001, "mm")], feature=Feature("point", TOP))


def text(html: str) -> str:
    return (
        re.sub(r"&#(\d+);", lambda m: chr(int(m[1])), html)
        .replace("\u2060", "")
        .replace("\xa0", " ")
        .replace("<wbr>", "")
    )


def test_tool_states_instruction_and_ends_after_its_picks() -> None:
    tool = Tool()
    assert missing_facts(tool.instruction, "tool") == [] and not tool.clicks
    for name in (*PICK, *FIT, *COMPARE):
        tool.select(name)
        assert tool.instruction[0].isupper() and tool.instruction.endswith(".")
        assert tool.clicks == (name not in COMPARE)
    tool.select("Distance")
    assert tool.pick((1, 2)) is None and "second" in tool.instruction
    assert tool.pick((1, 2)) is None and "second" in tool.instruction  # a double click
    # ready for the next distance
    assert tool.pick((3, 4)) == ((1, 2), (3, 4)) and "first" in tool.instruction
    tool.select("Point")
    assert tool.pick(7) == (7,)
    tool.select("Sphere")
    assert tool.pick((1, 2)) is None and tool.pick((5, 6)) is None and tool.picked == [(5, 6)]
    assert "Fit sphere" in tool.instruction
    tool.select("")
    assert tool.picked == []


def test_drawing_lies_where_it_was_measured() -> None:
    segments, place = drawn(SPHERE.record, {})  # type: ignore[misc]
    away = np.linalg.norm(segments[:-3].reshape(-1, 3) - CENTRE, axis=1)
    assert np.allclose(away, 1.01 * 25) and np.array_equal(place, CENTRE)
    width = made(
        "distance", [Quantity("distance", 80.0, "mm", 0.1)], ends=[[-40, 0, 500], [40, 0, 500]]
    )
    segments, place = drawn(width.record, {})  # type: ignore[misc]
    assert np.allclose(segments[0, 0], [-40, 0, 500]) and np.allclose(segments[2, 1], [40, 0, 500])
    assert np.allclose(place, [0, 0, 488]) and label(width) == "<b>distance</b>: 80.000 ± 0.200 mm"
    related = made(
        "relation",
        [Quantity("distance from the centre", 30.0, "mm", 0.1)],
        of=("m_point", "m_sphere"),
    )
    assert drawn(related.record, {"m_point": POINT.record}) is None  # the sphere was deleted
    segments, _ = drawn(related.record, {"m_point": POINT.record, "m_sphere": SPHERE.record})  # type: ignore[misc]
    assert np.allclose(segments[0, 0], TOP) and np.allclose(segments[2, 1], CENTRE)
    tube = Feature("cylinder", CENTRE, np.array([0.0, 1.0, 0.0]), 8.0)
    cylinder = made("cylinder", [], feature=tube, region=Region.ball(CENTRE, 12.0))
    segments, _ = drawn(cylinder.record, {})  # type: ignore[misc]
    assert np.allclose(np.abs(segments[:-1, :, 1] - CENTRE[1]), 12) and np.ptp(
        segments[..., 0]
    ) == pytest.approx(16.16)
    plane = made("plane", [], feature=Feature("plane", CENTRE, np.array([0.0, 0.0, -1.0])))
    segments, _ = drawn(plane.record, {})  # type: ignore[misc]
    assert np.allclose(segments[:-1, :, 2], CENTRE[2] - 0.15)


@pytest.mark.computes
def test_a_section_is_read_off_at_its_cursors() -> None:
    plane = CutPlane.through(
        np.array([0.0, 0, 500]), np.array([100.0, 0, 500]), np.array([0.0, 0, -1])
    )
    t = np.linspace(0, np.pi, 721)
    arc = np.stack([50 - 50 * np.cos(t), 50 * np.sin(t)], axis=1)
    cursors = cursor_points([arc], (10.0, 90.0, 50.0))
    assert cursors[:, 1] == pytest.approx([30, 30, 50], abs=1e-3)
    assert np.allclose(
        lifted(plane, cursors), [[10, 0, 470], [90, 0, 470], [50, 0, 450]], atol=1e-3
    )
    words = text(cursor_html(cursors))
    assert "80.000 mm" in words and "50.000 mm" in words and "0.000 mm" in words
    assert missing_facts(text(cursor_html(np.array([[0.0, 0], [2, 0], [1, 0]]))), "line") == []
    assert "equal" in section_plot("s", [arc], dict(zip("ABC", cursors, strict=True))).caption
    flat = arc * [1, 0.01]
    assert "enlarged" in section_plot("s", [flat]).caption
    cut = made("section", [], plane=plane)
    segments, place = drawn(cut.record, {}, [arc])  # type: ignore[misc]
    # the highest point, a little off
    assert np.allclose(segments[..., 1], 0) and place[2] == pytest.approx(449)


def test_measurements_as_text() -> None:
    assert Quantity("x", -0.00001, "mm").format() == "0.000 mm"
    assert Quantity("height", -1.5, "mm", 0.1).format() == "−1.500 ± 0.200 mm"
    assert Quantity("angle", 90.0, "deg", 0.01, whole=False).format() == "90.000 ± 0.020°*"
    full = text(measurement_html(SPHERE, {"scan_01": "Lion <i>"}))
    assert missing_facts(full, "25.000", "0.020", "rough", "Lion <i>", "sphere") == []
    assert (
        "<b>sphere" not in measurement_html(SPHERE, {}) and missing_facts(full, "calibration") == []
    )
    stale = made("point", [Quantity("x", 1.0, "mm")], stale=True)
    listed = text(measurements_table([SPHERE, stale], {"scan_01": "Lion"}))
    assert listed.index("m_point, stale") < listed.index("m_sphere") and listed.count("Lion") == 2
    ends = dict(lowest=-0.2, highest=0.3, p_low=-0.09, p_high=0.1, within_95=0.05)
    verdict = dict(
        tolerance_mm=0.1,
        U_mm=0.02,
        within=95.0,
        inside=90.0,
        close=9.0,
        outside=1.0,
        decision="undecided",
    )
    found = dict(
        nominal=dict(name="part.stl", hash="a"),
        statistics_mm=dict(mean=0.0, rms=0.02, sigma=0.02, points=900, left_out=100, **ends),
        verdict=dict(**verdict, lowest=(-0.09, "pass"), highest=(0.1, "undecided")),
        T_nominal_scan=np.eye(4), noise_mm=0.01, reach_mm=2.0, coverage=0.5, alignment_mm=0.001,
    )  # fmt: skip
    told = text(measurement_html(made("deviation", [], deviation=found), {}))
    facts = (
        f"± 0.1 mm: {DECIDED['undecided']}",
        "90.0000",
        "9.0000",
        "1.0000",
        "10.0 %",
        "2 mm",
        "part.stl",
    )
    assert missing_facts(told, *facts) == []
    edges = np.linspace(-0.2, 0.2, 9)
    arrays = {"edges": edges, "counts": np.arange(8), "signed": edges}
    assert deviation_figure("d", arrays, 0.1).png.startswith(b"\x89PNG")


def test_a_merge_is_painted_and_clicked_as_a_scan_is() -> None:
    points = np.stack([np.arange(5.0), np.zeros(5), np.full(5, 300.0)], axis=1).astype(np.float32)
    merge = MeasuredSurface(
        points,
        np.full(5, 0.1, np.float32),
        "merge/1",
        "stereo",
        {},
        texture=np.full((5, 3), 9, np.uint8),
    )
    assert place_at(merge, np.zeros(3), points[3]) == 3
    painted, _ = paint_points(surface_values(merge), "texture")
    assert painted.shape == (5, 3) and painted.max() == 9
    assert "normal" in text(paint_points(surface_values(merge), "uncertainty")[1])
    scan = MeasuredSurface(points[None], np.full((1, 5), 0.1, np.float32), "scan_01", "stereo", {})
    assert place_at(scan, np.zeros(3), points[3]) == (3, 0)
    assert "no texture" in text(paint_points(surface_values(scan), "texture")[1])


def test_notes_on_uncertainty_say_what_holds_for_the_rows_and_say_it_once() -> None:
    whole = Quantity("distance", 5.0, "mm", 0.1)
    scatter = Quantity("distance", 5.0, "mm", 0.1, whole=False)
    residual = Quantity("form", 0.1, "mm")

    def notes(*quantities: Quantity) -> list[str]:
        return list(
            list_quantities(
                {f"m{k}": made("distance", [q]).record for k, q in enumerate(quantities)}
            ).notes
        )

    (only,) = notes(scatter)
    assert "alone" in only and "unknown" in only
    (only,) = notes(whole)
    assert "unknown" not in only
    assert len(notes(whole, residual)) == 2 and notes(residual) == notes(whole, residual)[1:]
    both = notes(whole, scatter)
    assert both[0] == only and "m1" in both[1] and "m0" not in both[1]
    one = [made("distance", [scatter])]
    shown = text(measurement_html(one[0], {})) + text(measurements_table(one, {}))
    assert shown.count("expanded") == 1
