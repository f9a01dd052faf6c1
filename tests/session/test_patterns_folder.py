"""Patterns written for another projector come back through `import frames`."""

import numpy as np
import pytest

from slviewer.errors import InputError
from slviewer.fringe.decode import decode
from slviewer.fringe.presets import PRESETS
from slviewer.session.exporters import write_pattern_folder
from slviewer.session.importers import frames as frames_layout

PROJECTOR = (120, 90)


@pytest.mark.computes
@pytest.mark.parametrize("preset", list(PRESETS))
def test_a_camera_that_sees_the_patterns_themselves_decodes_its_own_pixels(tmp_path, preset):
    sequence = PRESETS[preset](PROJECTOR)
    write_pattern_folder(tmp_path / "patterns", sequence)
    (capture,) = frames_layout.LAYOUT.read(
        tmp_path / "patterns", tmp_path / "patterns" / "sequence.toml"
    )
    assert capture.sequence == sequence and capture.settings == {"gray_origin_given": True}
    truth = {"x": np.arange(120.0)[None, :], "y": np.arange(90.0)[:, None]}
    for axis in sequence.axes:
        # neither dark nor saturated
        phase = decode(capture.sequence, capture.frames // 2 + 40, axis)
        assert phase.mask.mean() > 0.97
        error = (phase.coordinate - truth[axis])[phase.mask]
        assert np.abs(error).max() < 0.1


def test_a_folder_with_something_in_it_is_refused(tmp_path):
    sequence = PRESETS["gray"](PROJECTOR)
    (tmp_path / "empty").mkdir()
    write_pattern_folder(tmp_path / "empty", sequence)
    with pytest.raises(InputError):
        write_pattern_folder(tmp_path / "empty", sequence)
