"""What the operator decides of a rig: several exposures, a name, and what its choice says of its
camera."""

import logging
import zipfile
from pathlib import Path

import numpy as np
import pytest
from facts import missing_facts
from test_operator import TARGET, states
from wizard_events import HANG_S, SPARING, last_notice, until, wait_until_open

from slviewer.gui.widgets import PICTURE_PX, draw_preview
from slviewer.pipeline.capture import capture
from slviewer.pipeline.examination import Preflight
from slviewer.pipeline.rig_choice import load_rig
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import PreviewView

pytestmark = pytest.mark.computes

RIG = {"driver": "simulated", "scale": 0.25, "seed": 0, "exposure_ms": 0.8}


@pytest.fixture
def operator(tmp_path: Path):
    with Operator(tmp_path / "session", RIG, timing=SPARING) as operator:
        operator.choose_target(TARGET)
        wait_until_open(operator)
        yield operator


def lacks(operator: Operator, *facts: object) -> list[str]:
    """Return the facts that the latest notice, a failed request's, lacks."""
    notice = operator.wait_until_idle().notices[-1]
    assert notice.level == "error"
    return missing_facts(notice.text, *facts)


@pytest.mark.slow
def test_poses_in_several_exposures_are_judged_as_others_are(operator: Operator) -> None:
    once = operator.wait_until_idle()
    assert (
        once.rig.exposure_ms == 0.8 and once.session is not None and once.session.exposures_ms == ()
    )
    assert operator.set_exposures((4.0, 0.5))
    before = operator.wait_until_idle()
    assert before.session is not None and before.session.exposures_ms == (0.5, 4.0)
    assert (
        before.space is not None and once.space is not None and once.space.capture_bytes is not None
    )
    assert before.space.capture_bytes == 2 * once.space.capture_bytes
    assert operator.capture_pose()
    after = operator.wait_until_idle()
    assert (
        states(after) == {"pose_01": "good"}
        and after.session is not None
        and after.session.poses[0].thumbnail
    )
    assert operator.session is not None and operator.session.load_capture(
        "pose_01"
    ).exposures_ms == (0.5, 4.0)
    assert operator.wait_until_idle().rig.exposure_ms == 0.8
    assert (
        operator.set_exposures((4.0, 4.0)) is False and lacks(operator, "exposures", "4, 4") == []
    )
    assert operator.set_exposures(())
    assert operator.capture_pose()
    operator.wait_until_idle()
    assert operator.session.load_capture("pose_02").exposures_ms == ()


def test_a_pose_that_is_too_bright_is_warned_of(operator: Operator) -> None:
    assert operator.set_exposure(20.0)
    assert operator.wait_for(lambda s: s.rig.exposure_ms == 20.0, HANG_S)
    assert operator.capture_pose()
    notices = operator.wait_until_idle().notices
    assert [
        each.text.partition(":")[0] for each in notices if each.section == "check-exposure"
    ] == ["pose_01"]


@pytest.mark.slow
def test_a_suggested_exposure_is_set_and_can_be_undone(operator: Operator) -> None:
    assert operator.set_exposure(20.0) and operator.set_exposures((20.0, 90.0))  # far too bright
    assert operator.undo_exposure() is False and lacks(operator, "exposure") == []
    assert operator.suggest_exposure()
    after = operator.wait_until_idle()
    change, session = after.exposure_change, after.session
    assert (
        change is not None
        and session is not None
        and last_notice(after) == change.suggestion.text()
    )
    exposures = change.suggestion.exposures_ms
    assert 0.7 < exposures[0] < 1.5  # at 1 ms the brightest reach the sensor's peak level
    assert change.suggestion.share > 0.95 and change.suggestion.share_before < 0.2
    assert session.exposures_ms == (exposures if len(exposures) > 1 else ())
    assert operator.wait_for(lambda s: s.rig.exposure_ms == pytest.approx(exposures[0]), HANG_S)
    assert operator.capture_pose() and states(operator.wait_until_idle()) == {"pose_01": "good"}
    assert operator.suggest_exposure(for_scan=True) is False and lacks(operator, "calibrate") == []
    assert operator.undo_exposure()
    undone = operator.wait_until_idle()
    assert undone.exposure_change is None and undone.session is not None
    assert undone.session.exposures_ms == (20.0, 90.0)
    assert operator.wait_for(lambda s: s.rig.exposure_ms == 20.0, HANG_S)


def test_a_rig_is_kept_under_a_name_with_its_exposure(operator: Operator) -> None:
    assert operator.set_exposure(2.5)
    assert operator.wait_for(lambda s: s.rig.exposure_ms == 2.5, HANG_S)
    assert operator.set_exposures((1.0, 8.0))
    assert operator.save_rig("mine", "With a longer exposure.")
    assert operator.session is not None
    assert load_rig("mine", operator.session) == {**RIG, "exposure_ms": 2.5, "gain": 1.0}
    assert operator.save_rig("../mine") is False and lacks(operator, "../mine", "name") == []
    assert operator.choose_rig({**RIG, "exposure_ms": 1.5})
    now = operator.wait_for(lambda s: s.rig.exposure_ms == 1.5, HANG_S)
    assert now is not None and now.session is not None and now.session.exposures_ms == ()


def test_several_exposures_follow_the_one_that_they_were_chosen_by(operator: Operator) -> None:
    assert operator.session is not None
    assert operator.set_exposures((0.8, 3.2))
    # both before the camera has said anything
    assert operator.set_exposure(1.6) and operator.set_exposure(0.4)
    assert operator.session.decision("exposures") == pytest.approx([0.4, 1.6])


@pytest.mark.slow
def test_a_rig_chosen_once_more_keeps_what_was_measured_and_set(operator: Operator) -> None:
    session = operator.session
    assert session is not None and operator.set_exposure(2.0)
    operator._set_preflight(Preflight((), 37.0, None, None, 1.0))
    assert operator.choose_rig(RIG)
    assert (
        session.decision("rig") == {**RIG, "settle_ms": 37.0}
        and session.decision("exposure")["exposure_ms"] == 2.0
    )
    assert operator.choose_rig({**RIG, "settle_ms": 5.0})  # said by whoever chose it
    assert (
        session.decision("rig")["settle_ms"] == 5.0
        and session.decision("exposure")["exposure_ms"] == 2.0
    )
    assert operator.choose_rig({**RIG, "scale": 0.2})
    assert "settle_ms" not in session.decision("rig") and session.decision("exposure") is None


@pytest.mark.slow
def test_what_a_check_finds_belongs_to_the_rig_that_was_checked(operator: Operator) -> None:
    assert operator.check_rig()
    assert operator.wait_for(
        lambda s: s.rig.capture is not None and s.rig.capture.frame > 0, HANG_S
    )
    other = {**RIG, "scale": 0.2}
    assert operator.choose_rig(other)
    assert operator.wait_for(lambda s: s.rig.state == "open" and s.rig.choice == other, HANG_S)
    after = operator.wait_until_idle()
    assert after.preflight is None and after.rig.choice == other
    assert missing_facts(last_notice(after), "Checking the rig", "cancelled") == []


@pytest.mark.slow
def test_a_session_opens_without_the_rig_that_it_remembers(
    operator: Operator, tmp_path: Path
) -> None:
    missing = {
        "camera": {"driver": "opencv", "source": str(tmp_path / "no.avi")},
        "projector": {"driver": "browser", "size": [640, 480]},
    }
    with Session.create(tmp_path / "other") as store:
        store.decide("rig", missing)
        store.decide("exposure", {"exposure_ms": 3.0, "gain": None})
    assert operator.open_session(tmp_path / "other") and operator.session is not None
    view = operator.wait_until_idle()
    assert (
        view.rig.state == "lost"
        and missing_facts(view.rig.fault, "no.avi") == []
        and view.rig.choice == missing
    )
    assert missing_facts(view.step("rig").problems[0], "no.avi") == []
    assert not operator.choose_rig(missing)  # as the button "Try this rig again" asks
    assert (
        operator.session.decision("rig") == missing
        and operator.session.decision("exposure")["exposure_ms"] == 3.0
    )
    assert operator.choose_rig(RIG) and operator.wait_for(lambda s: s.rig.state == "open", HANG_S)


def test_sessions_of_one_rig_have_exposures_of_their_own(
    operator: Operator, tmp_path: Path
) -> None:
    with Session.create(tmp_path / "other") as store:
        store.decide("rig", RIG)
        store.decide("exposure", {"exposure_ms": 3.0, "gain": 1.0})
    assert operator.open_session(tmp_path / "other")
    assert operator.wait_for(lambda s: s.rig.exposure_ms == 3.0, HANG_S)


@pytest.mark.slow
def test_an_open_session_can_be_opened_again_by_any_path_and_with_another_rig(
    operator: Operator, tmp_path: Path
) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "session")
    (tmp_path / "inner").mkdir()
    store = operator.session
    assert operator.open_session(tmp_path / "link") and operator.open_session(
        tmp_path / "inner" / ".." / "session"
    )
    assert operator.session is store
    assert operator.open_session(tmp_path / "link", {**RIG, "exposure_ms": 1.5})
    assert (
        operator.session is store
        and store is not None
        and store.decision("rig")["exposure_ms"] == 1.5
    )
    assert operator.wait_for(lambda s: s.rig.exposure_ms == 1.5, HANG_S)


@pytest.mark.slow
def test_a_recording_is_not_asked_for_light_that_it_does_not_hold(
    operator: Operator, tmp_path: Path
) -> None:
    capture(tmp_path / "recorded", "a", RIG, patterns="p18")
    assert operator.set_light("pattern") and operator.wait_for(
        lambda s: s.rig.light == "pattern", HANG_S
    )
    assert operator.choose_rig({"driver": "replay", "source": str(tmp_path / "recorded")})
    now = operator.wait_for(lambda s: s.rig.name == "replay" and s.rig.state != "opening", HANG_S)
    assert now is not None and now.rig.state == "open", now and now.rig.fault
    assert not operator.set_light("dark") and lacks(operator, "dark") == []
    assert now.rig.projector is not None
    width, height = now.rig.projector
    assert not operator.show_image(np.zeros((height, width, 3), np.uint8))
    assert lacks(operator, "patterns alone", "PNG") == []


def test_an_image_is_shown_until_another_light_is_chosen(operator: Operator) -> None:
    assert operator.wait_for(lambda s: s.rig.state == "open", HANG_S)
    projector = operator._require_bench().rig.projector
    width, height = projector.size
    image = np.zeros((height, width, 3), np.uint8)
    assert not operator.show_image(image[1:]) and lacks(operator, str(height)) == []
    assert operator.show_image(image)
    until(lambda: projector.world.shown.pattern[1] is image)
    assert operator.wait_for(lambda s: s.rig.light == "image", HANG_S)
    assert operator.set_light("white")
    until(lambda: (projector.world.shown.pattern[1] == 255).all())


def test_a_diagnostic_bundle_tells_no_password(tmp_path: Path) -> None:
    with Operator(tmp_path / "session") as operator:
        assert operator.session is not None
        camera = {
            "driver": "opencv",
            "source": "rtsp://somebody:s3cret@camera.local/1",
            "size": [8, 8],
        }
        operator.session.decide(
            "rig", {"camera": camera, "projector": {"driver": "browser", "size": [8, 8]}}
        )
        logging.getLogger("slviewer").info("rtsp://somebody:s3cret@camera.local/1 is slow")
        assert operator.set_report_details(customer="Unnamed Ltd")
        assert operator.diagnostic_bundle()
        operator.wait_until_idle()
        with zipfile.ZipFile(next(operator.session.exports.glob("*.zip"))) as bundle:
            texts = {
                name: bundle.read(name).decode()
                for name in bundle.namelist()
                if name.endswith(("json", "txt"))
            }
    assert not any("s3cret" in text or "Unnamed" in text for text in texts.values())
    assert (
        "rtsp://…@camera.local/1" in texts["log.txt"]
        and "camera.local" in texts["session/decisions.json"]
    )


def test_a_rig_of_two_cameras_captures_and_shows_both(tmp_path: Path) -> None:
    previews = list[PreviewView]()
    rig = {"driver": "simulated", "scale": 0.25, "cameras": 2}
    with Operator(tmp_path / "session", rig, timing=SPARING) as operator:
        operator.subscribe(lambda _: None, previews.append)
        operator.choose_target(TARGET)
        wait_until_open(operator)
        assert operator.capture_pose()
        after = operator.wait_until_idle(HANG_S)
        assert states(after) == {"pose_01": "good"}
        until(lambda: any(each.second is not None for each in previews))
        assert operator.session is not None
        saved = operator.session.load_capture("pose_01")
        assert saved.second is not None and saved.other_size == (400, 300)
        frames = len(saved.sequence.frames)
        assert after.space is not None and after.space.capture_bytes == 2 * frames * 400 * 300
        shown = draw_preview(next(each for each in previews if each.second is not None))
        assert shown.shape[1] == 2 * PICTURE_PX
