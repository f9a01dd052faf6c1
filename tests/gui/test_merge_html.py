"""What the step Merge says and paints, without a browser."""

from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
from facts import missing_facts

from slviewer.gui.colouring import (
    DISTANCE,
    SCAN,
    SCAN_COLOURS,
    SHAPE,
    TEXTURE,
    UNCERTAINTY,
    PointValues,
    paint_points,
)
from slviewer.gui.merge_views import (
    colour_merge,
    merge_failure_html,
    merge_html,
    turntable_html,
)
from slviewer.pipeline.operation import Stored, save_record
from slviewer.records.merge import LoopClosure, Merge, RefusedPair, Registered
from slviewer.records.record import use_labels
from slviewer.session.ply import write_ply
from slviewer.session.store import Session

LABELS = {"scan_01": "Lion <b>", "scan_02": "scan_02", "scan_03": "Lion, behind", "scan_10": "Tail"}
TURNED = ((1.0, 0.0, 0.0, 10.0), (0.0, 0.9, -0.1, 0.0), (0.0, 0.1, 0.9, 0.0), (0.0, 0.0, 0.0, 1.0))


def pair(scan: str, onto: str, **figures: Any) -> Registered:
    known = {
        "sigma_shift_mm": 0.0231,
        "sigma_turn_deg": 0.0363,
        "middle": (0.0, 0.0, 600.0),
    } | figures
    return Registered(
        scan=scan, onto=onto, rms_mm=0.117, overlap=0.2, T_reference_scan=TURNED, **known
    )


def test_pairs_loops_and_excluded_scans_are_named_by_labels() -> None:
    merge = Merge(
        reference="scan_01",
        scans=["scan_01", "scan_02", "scan_03"],
        points=197_971,
        pairs={},
        registered=[
            pair("scan_03", "scan_02"),
            pair("scan_02", "scan_01", point_to_point_rms_mm=0.24),
        ],
        loops=[LoopClosure(["scan_02", "scan_03", "scan_01"], 0.016, 0.0284, 0.004, 0.0059)],
        dropped=[
            RefusedPair(
                "scan_03", "scan_01", "scan_03 -> scan_01 contradicts the other pairs by 3.1 mm"
            )
        ],
        refused=[RefusedPair("scan_10", "scan_01", "Only 3 % of the scan lies on the reference")],
        left_out={
            "scan_01": {"edges": 5500, "grazing": 0},
            "scan_02": {"edges": 27, "unconfirmed": 8},
        },
        shared=0.99,
    )
    shown = merge_html(Stored("2", "2", merge, stale=True), LABELS)
    said = unescape(shown).replace("\xa0", " ")
    # the reference first
    assert "Lion <b>" not in shown and said.index("Lion <b>") < said.index("Lion, behind")
    facts = (
        "0.117", "0.0231", "0.016", "0.004", "0.26", "0.25 mm", "Letter", "0.24 mm",
        "Lion, behind -> Lion <b>", "Tail onto Lion <b>", "3 %", "197,971 points", "99 %",
        "5,527 at depth edges",
        "8 contradicted", "Out of date",
    )  # fmt: skip
    assert missing_facts(said, *facts) == [] and "grazing" not in said
    before = pair("scan_02", "scan_01", sigma_shift_mm=None, sigma_turn_deg=None, middle=None)
    old = Merge(
        reference="scan_01", scans=["scan_01", "scan_02"], points=10, pairs={}, registered=[before]
    )
    bare = unescape(merge_html(Stored("1", "1", old), LABELS))
    assert (
        "0.117" in bare
        and "Letter" not in bare
        and "LoopClosure" not in bare
        and "sigma" not in bare.lower()
    )


def test_labels_in_messages_and_angles() -> None:
    assert use_labels("scan_01, scan_100 and scan_10.", LABELS) == "Lion <b>, scan_100 and Tail."
    assert (
        missing_facts(
            unescape(merge_failure_html("scan_01: no overlap", LABELS)), "Lion <b>: no overlap"
        )
        == []
    )
    turned = unescape(
        turntable_html(["scan_02", "scan_10", "scan_03"], [0.0, 22.5, 45.0], LABELS)
    ).replace("\xa0", " ")
    assert "scan_02 at 0°, Tail at 22.5°, Lion, behind at 45°. " in turned
    assert "a at 0°, b at 30°, c at 60°, …, e at 120°. " in unescape(
        turntable_html(list("abcde"), [0.0, 30.0, 60.0, 90.0, 120.0], {})
    )


def test_merged_points_by_scan_and_by_uncertainty(tmp_path: Path) -> None:
    points = np.arange(12, dtype=np.float32).reshape(4, 3)
    scalars = {
        "sigma": np.array([0.01, 0.02, 0.03, np.nan], np.float32),
        "source": np.array([0, 1, 1, 2], np.uint8),
    }
    with Session.create(tmp_path / "session") as store:
        store.exports.mkdir(exist_ok=True)
        write_ply(
            store.exports / "merged_1.ply",
            points,
            np.array([10, 20, 30, 40], np.uint8),
            None,
            scalars,
        )
        write_ply(store.exports / "merged_2.ply", points)
        merges = []
        for number in ("1", "2"):
            made = Merge(reference="a", scans=["a"], pairs={}, ply=f"merged_{number}.ply")
            save_record(store, number, made, {})
            merges.append(Stored(number, number, made))
        by_scan = colour_merge(store, merges[0], SCAN, ["a", "b", "<c>"])
        assert by_scan.clouds["merged"][1][3].tolist() == list(
            SCAN_COLOURS[2]
        ) and "<c>" in unescape(by_scan.legend)
        by_sigma = colour_merge(store, merges[0], UNCERTAINTY, [])
        assert by_sigma.clouds["merged"][1][3].tolist() == [128, 128, 128]
        legend = unescape(by_sigma.legend).replace("\xa0", " ")
        assert missing_facts(legend, "0.010 mm", "grey") == []
        assert colour_merge(store, merges[0], TEXTURE, []).clouds["merged"][1][1].tolist() == [
            20,
            20,
            20,
        ]
        assert (
            missing_facts(unescape(colour_merge(store, merges[1], SCAN, []).legend), "merge again")
            == []
        )
        assert by_sigma.points.shape == (4, 3) and by_sigma.view == by_scan.view


def test_shape_is_darker_where_it_turns_from_the_light() -> None:
    points = np.zeros((3, 3), np.float32)
    normals = np.array([[-0.35, -0.5, -0.79], [0, 0, 1], [np.nan] * 3], np.float32)
    painted, legend = paint_points(PointValues(points, normals, {}), SHAPE)
    assert painted[0, 0] > painted[2, 0] > painted[1, 0] > 0 and legend == ""
    scan = np.array([0.0, 0.001, np.nan], np.float32)
    painted, legend = paint_points(PointValues(points, normals, {DISTANCE: scan}), DISTANCE)
    assert missing_facts(unescape(legend).replace("\xa0", " "), "0.001 mm", "unknown") == []
