"""What the panel shows of exposures, without a browser."""

from html import unescape

import numpy as np
import pytest
from facts import missing_facts

from slviewer.gui.capture_inputs import draw_suggestion, name_exposures, suggestion_html
from slviewer.pipeline.suggest_exposure import STATES, ExposureSuggestion


def test_suggestion_is_drawn_before_and_after() -> None:
    state = np.full((6, 8), STATES.index("measured"), np.uint8)
    before = state.copy()
    before[:, :2], before[:, 2:4], state[0] = (
        STATES.index("saturated"),
        STATES.index("dark"),
        STATES.index("unlit"),
    )
    image = np.full((6, 8), 200, np.uint8)
    suggestion = ExposureSuggestion((1.0, 8.0), 1.0, 0.875, 0.5, 3.25, state, before, image, 1)
    picture = draw_suggestion(suggestion)
    assert picture.shape[0] == 6 and picture.dtype == np.uint8
    left, right = picture[:, :8], picture[:, -8:]
    red, blue, grey = left[3, 0], left[3, 3], left[3, 6]
    assert red[0] > 2 * red[2] and blue[2] > 2 * blue[0] and (grey == 200).all()
    assert (right[1:] == 200).all() and (right[0] < 100).all(), (
        "what the projector does not light is dim"
    )
    assert (
        missing_facts(
            unescape(suggestion_html(suggestion)), "50.0 % measured", "87.5 % measured", "capture"
        )
        == []
    )


@pytest.mark.parametrize(
    ("exposures", "label"),
    [
        ((), "1"),
        ((2.0, 8.0), "2: 1×, 4×"),
        ((0.5, 2.0, 8.0), "3: ¼×, 1×, 4×"),
        ((2.0, 9.3), "as suggested"),
    ],
)
def test_exposures_are_named_by_their_multiples(exposures: tuple[float, ...], label: str) -> None:
    assert name_exposures(exposures, 2.0) == label
