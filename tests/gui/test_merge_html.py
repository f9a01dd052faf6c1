"""What the step Merge says and paints, without a browser."""

from html import unescape
from pathlib import Path

import numpy as np
from facts import missing_facts

from slviewer.gui.merge_html import merge_failure_html, merge_html, turntable_html, use_labels
from slviewer.gui.merge_views import BY_SCAN, BY_SIGMA, OWN, SCAN_COLOURS, colour_merge
from slviewer.session.ply import write_ply
from slviewer.session.store import Session
from slviewer.wizard.snapshot import MergedLoop, MergedPair, MergeView

LABELS = {"scan_01": "Lion <b>", "scan_02": "scan_02", "scan_03": "Lion, behind", "scan_10": "Tail"}
PAIR = MergedPair("scan_02", "scan_01", 0.117, 0.2, 0.0231, 0.0363, 297.2, 4.46, 0.24)


def test_pairs_loops_and_excluded_scans_are_named_by_labels() -> None:
    pairs = (MergedPair("scan_03", "scan_02", 0.082, 0.99, 0.0187, 0.0286, 145.1, 9.77, 0.2), PAIR)
    merge = MergeView(
        name="2",
        reference="scan_01",
        scans=("scan_01", "scan_02", "scan_03"),
        points=197_971,
        pairs={},
        stale=True,
        registered=pairs,
        loops=(MergedLoop(("scan_02", "scan_03", "scan_01"), 0.016, 0.0284, 0.004, 0.0059),),
        dropped=("scan_03 -> scan_01 contradicts the other pairs by 3.1 mm and 2.0 degrees, and is left out",),
        refused=("scan_10 -> scan_01: Only 3 % of the scan lies on the reference",),
        stray={"edges": 5527, "grazing": 0, "unconfirmed": 8},
        shared=0.99,
    )
    shown = merge_html(merge, LABELS)
    said = unescape(shown).replace("\xa0", " ")
    assert "Lion <b>" not in shown and said.index("to Lion <b>") < said.index("to scan_02")  # the reference first
    facts = (
        "0.0231 mm<br>0.0363°", "297.20 mm<br>4.46°", "0.016 mm<br>0.0284°", "0.004 mm<br>0.0059°", "orange",
        "0.26", "0.25 mm", "Letter", "0.24 mm", "Lion, behind -> Lion <b>", "Tail -> Lion <b>", "3 %", "197,971 points",
        "99 %", "5,527 at depth edges", "8 contradicted", "merge again",
    )  # fmt: skip
    assert missing_facts(said, *facts) == [] and "grazing" not in said
    before = MergedPair("scan_02", "scan_01", 0.117, 0.2, None, None, None, 4.46)
    bare = unescape(merge_html(MergeView("1", "scan_01", ("scan_01", "scan_02"), 10, {}, False, (before,)), LABELS))
    assert "–</td>" in bare and "4.46°" in bare and "Letter" not in bare and "Loop" not in bare


def test_labels_in_messages_and_angles() -> None:
    assert use_labels("scan_01, scan_100 and scan_10.", LABELS) == "Lion <b>, scan_100 and Tail."
    assert missing_facts(unescape(merge_failure_html("scan_01: no overlap", LABELS)), "Lion <b>: no overlap") == []
    turned = unescape(turntable_html(["scan_02", "scan_10", "scan_03"], [0.0, 22.5, 45.0], LABELS)).replace("\xa0", " ")
    assert "scan_02 at 0°, Tail at 22.5°, Lion, behind at 45°. " in turned
    assert "a at 0°, b at 30°, c at 60°, …, e at 120°. " in unescape(
        turntable_html(list("abcde"), [0.0, 30.0, 60.0, 90.0, 120.0], {})
    )


def test_merged_points_by_scan_and_by_uncertainty(tmp_path: Path) -> None:
    points = np.arange(12, dtype=np.float32).reshape(4, 3)
    scalars = {"sigma": np.array([0.01, 0.02, 0.03, np.nan], np.float32), "source": np.array([0, 1, 1, 2], np.uint8)}
    with Session.create(tmp_path / "session") as store:
        store.exports.mkdir(exist_ok=True)
        write_ply(store.exports / "merged_1.ply", points, np.array([10, 20, 30, 40], np.uint8), None, scalars)
        write_ply(store.exports / "merged_2.ply", points)
        for number in ("1", "2"):
            store.save_result(f"merge/{number}", {"ply": f"merged_{number}.ply"}, {})
        by_scan = colour_merge(store, "1", BY_SCAN, ["a", "b", "<c>"])
        assert by_scan.clouds["merged"][1][3].tolist() == list(SCAN_COLOURS[2]) and "<c>" in unescape(by_scan.legend)
        by_sigma = colour_merge(store, "1", BY_SIGMA, [])
        assert by_sigma.clouds["merged"][1][3].tolist() == [128, 128, 128]
        legend = unescape(by_sigma.legend).replace("\xa0", " ")
        assert missing_facts(legend, "0.010 mm", "grey") == []
        assert colour_merge(store, "1", OWN, []).clouds["merged"][1][1].tolist() == [20, 20, 20]
        assert missing_facts(unescape(colour_merge(store, "2", BY_SCAN, []).legend), "merge again") == []
        assert by_sigma.points.shape == (4, 3) and by_sigma.view == by_scan.view
