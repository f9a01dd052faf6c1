"""The panel of images on the part: made, shown with the rig's projector, dimmed, and off."""

from pathlib import Path

import numpy as np
from clocks import HANG_S, until
from playwright.sync_api import Browser
from wizard_page import CALM, click, field, new_page, unfold

from slviewer.gui.app import App
from slviewer.pipeline.operation import save_record
from slviewer.records.part_image import PartImage
from slviewer.server.secure import Serving
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator

RIG = {"driver": "simulated", "scale": 0.1}


def test_an_image_is_shown_dimmed_and_ended(tmp_path: Path, browser: Browser) -> None:
    image = np.full((1140, 912, 3), 200, np.uint8)
    record = PartImage(
        scan="part", of="missing", illuminated_share=0.1, position_sigma_px=0.1, pixel_mm=0.3,
        settings={"gamma": 1.0},
    )  # fmt: skip
    with Session.create(tmp_path / "session") as store:
        save_record(store, "1", record, {"image": image})
    with Operator(tmp_path / "session", RIG, timing=CALM) as operator:
        wizard, page = App(operator, Serving(port=0)), new_page(browser)
        assert operator.wait_for(lambda s: s.rig.state == "open", HANG_S)
        world = operator._require_bench().rig.projector.world

        def shown() -> float:
            return float(np.max(world.shown.pattern[1]))

        page.goto(wizard.server.link())
        click(page, "8. Measure")
        unfold(page, "Show on the part")
        click(page, "Show with the projector")
        assert until(lambda: shown() == 200)
        assert operator.wait_for(lambda s: s.rig.light == "image", HANG_S)
        field(page, "Light").fill("50")
        field(page, "Light").press("Enter")
        assert until(lambda: shown() == 100)
        click(page, "Off")
        assert until(lambda: shown() == 255)
        page.context.close()
        wizard.close()
