"""The figures: pictures of the right size, one scale where figures are compared, nothing invented
where data lack."""

import io
import threading
from typing import Any

import numpy as np
import pytest
from facts import missing_facts
from made_up import cloud, error_map, outlines, pixel_curve
from PIL import Image

from slviewer.errors import InputError
from slviewer.records.calibration import Reprojection
from slviewer.report import maps
from slviewer.report.maps import PixelCurve, coverage, pixel_curves, pose_bars, residual_arrows
from slviewer.report.page import DENSITY, FULL, MODELS, Figure, finish_figure, new_figure, round_up
from slviewer.report.planes import planes_in_space
from slviewer.report.surfaces import draw_clouds, draw_merged_cloud
from slviewer.surface.fuse import Fused
from slviewer.surface.shapes import PointSet

pytestmark = pytest.mark.computes

RMS = {"stereo": 0.2, "pixelwise": 0.08}


def opened(figure: Figure) -> np.ndarray:
    image = Image.open(io.BytesIO(figure.png))
    assert image.format == "PNG" and image.width == DENSITY * figure.width
    assert figure.alt and figure.caption
    return np.asarray(image.convert("RGB"))


def test_colours_stay_true_where_they_mean_something() -> None:
    drawing = new_figure(300, 200)
    axes = drawing.subplots()
    # thousands of colours that compete
    axes.imshow(np.random.default_rng(0).uniform(size=(200, 200, 3)))
    drawing.text(0.1, 0.9, "■", fontsize=30, color=MODELS["stereo"])
    image = opened(finish_figure(drawing, "c", "a")).reshape(-1, 3)
    assert (image == 255).all(axis=1).mean() > 0.1
    orange = np.array([int(MODELS["stereo"][i : i + 2], 16) for i in (1, 3, 5)])
    assert (np.abs(image.astype(int) - orange).max(axis=1) == 0).sum() > 100


def test_figures_can_be_drawn_by_several_threads() -> None:
    done: list[Figure] = []
    errors = Reprojection("stereo", {"camera": 0.1}, {"a": (0.1, 0.2)})
    threads = [threading.Thread(target=lambda: done.append(pose_bars(errors))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({figure.png for figure in done}) == 1 and len(done) == 2


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What the maps' figures hold before they become pixels."""
    kept: list[Any] = []

    def keep(drawing: Any, *words: str) -> Figure:
        kept.append(drawing)
        return finish_figure(drawing, *words)

    monkeypatch.setattr(maps, "finish_figure", keep)
    return kept


@pytest.mark.parametrize("width", [FULL, 528])
def test_error_maps_share_one_scale_centred_on_zero(drawn: list[Any], width: int) -> None:
    small, large = error_map(200, 0.05, 0.02, 1), error_map(200, 0.5, 0.02, 2)
    figure = maps.draw_error_maps(
        "pose 3", {"stereo": large, "pixelwise": small}, RMS, 0.036, width=width
    )
    assert opened(figure).shape[1] == DENSITY * width
    images = [image for axes in drawn[0].axes for image in axes.get_images()]
    limits = {image.get_clim() for image in images}
    assert len(images) == 2 and len(limits) == 1
    low, high = limits.pop()
    assert low == -high and 0.6 < high < 2.5


def test_maps_are_cropped_to_the_data_and_grey_where_there_is_none(drawn: list[Any]) -> None:
    errors = np.full((300, 400), np.nan, np.float32)
    errors[100:200, 150:300] = 0.1
    errors[140:150, 200:220] = np.nan
    other = errors.copy()
    other[:, 280:] = np.nan
    image = opened(maps.draw_error_maps("pose 3", {"stereo": errors, "pixelwise": other}, RMS))
    shown = [image for axes in drawn[0].axes for image in axes.get_images()]
    assert {s.get_array().shape for s in shown} == {(104, 154)}
    assert shown[0].get_cmap().get_bad()[:3] == pytest.approx(np.array([0xD5, 0xD9, 0xDE]) / 255)
    assert (image == [0xD5, 0xD9, 0xDE]).all(axis=2).sum() > 5000


def test_one_limit_for_many_figures() -> None:
    a, b = error_map(200, 0.05, 0.02, 1), error_map(200, 0.5, 0.02, 2)
    assert maps.error_limit([a, b]) == maps.error_limit([b]) or maps.error_limit(
        [a, b]
    ) < maps.error_limit([b])
    assert maps.error_limit([np.full((4, 4), np.nan)]) == 1.0


@pytest.mark.slow
def test_nothing_measured_is_drawn_as_nothing() -> None:
    empty = np.full((60, 80), np.nan, np.float32)
    opened(maps.draw_error_maps("pose", {"stereo": empty}, {"stereo": float("nan")}))
    opened(maps.rms_maps(np.full((3, 60, 80), np.nan)))
    opened(draw_clouds({"nothing": np.full((60, 80, 3), np.nan, np.float32)}))
    nothing = PointSet(*2 * [np.zeros((0, 3), np.float32)])
    opened(draw_merged_cloud(Fused(nothing, *2 * [np.zeros(0, np.uint8)], (), {}, {})))


def test_scales_end_at_round_values() -> None:
    assert [round_up(v) for v in (0.011, 0.4, 7, 0.95, float("nan"))] == pytest.approx(
        [0.015, 0.4, 8, 1, 1]
    )


@pytest.mark.slow
def test_the_pixels_curve_and_its_residuals() -> None:
    figure = pixel_curves(pixel_curve())
    opened(figure)
    assert missing_facts(figure.caption, "(500, 500)", "24 target poses", "30 µm") == []
    nothing = np.full(3, np.nan)
    opened(
        pixel_curves(
            PixelCurve((1, 2), "x", nothing, nothing, nothing, nothing, np.ones(5), np.ones(3))
        )
    )


@pytest.mark.slow
def test_planes_are_named_by_what_differs() -> None:
    figure = planes_in_space(outlines(), (500, 700))
    opened(figure)
    assert missing_facts(figure.caption, "10 planes", 500, "700 mm") == []
    points = np.random.default_rng(0).uniform(-50, 50, (500, 3)) * [1, 1, 0] + [0, 0, 480]
    points[0] = np.nan
    opened(planes_in_space({"only": points}, (500, 700)))


def test_reprojection_figures() -> None:
    rng = np.random.default_rng(2)
    pixels, residuals = rng.uniform(0, 400, (50, 2)), rng.normal(0, 0.1, (50, 2))
    residuals[3] = np.nan
    figure = residual_arrows("pose_03", pixels, residuals, (640, 480))
    assert missing_facts(figure.alt, "49 positions") == []
    assert missing_facts(figure.caption, "noise") == []
    opened(figure)
    swirl = 0.1 * np.column_stack([200 - pixels[:, 1], pixels[:, 0] - 200]) / 200
    order = np.lexsort((pixels[:, 0], pixels[:, 1] // 60))
    figure = residual_arrows("pose_03", pixels[order], swirl[order], (640, 480))
    assert missing_facts(figure.caption, "pattern") == [] and "noise" not in figure.caption
    worst = pose_bars(
        Reprojection(
            "splined", {"camera": 0.1}, {"a": (0.1, 0.2), "b": (0.1, np.nan), "c": (0.3, 0.1)}
        )
    )
    assert missing_facts(worst.caption, "worst", "c", "splined") == []
    square = np.array([[0, 0], [320, 0], [320, 479], [0, 479]], float)
    assert missing_facts(coverage("camera", (640, 480), [square, square[:2]]).alt, "50 %") == []


@pytest.mark.slow
def test_clouds_are_counted() -> None:
    points = cloud(160, 590)
    count = f"{np.isfinite(points[..., 2]).sum():,} points"
    figure = draw_clouds({f"scan <{i}>": points for i in range(4)})
    assert missing_facts(figure.alt, count) == []
    opened(figure)


@pytest.mark.parametrize(
    "draw",
    [
        lambda: maps.draw_error_maps("t", {}, {}),
        lambda: maps.draw_error_maps("t", {"a": np.zeros((2, 3)), "b": np.zeros((3, 2))}, RMS),
    ],
)
def test_what_cannot_be_drawn_is_refused(draw: Any) -> None:
    with pytest.raises(InputError):
        draw()
