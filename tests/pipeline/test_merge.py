"""What `merge` is told of where scans lie, before it computes anything; the whole way is in test_commands."""

import numpy as np
import pytest

from slviewer.errors import UsageError
from slviewer.pipeline.merge import merge
from slviewer.registration.refusal import Refused


def test_starts_that_do_not_fit_together_are_refused_at_once(tmp_path) -> None:
    out = tmp_path / "merged.ply"
    with pytest.raises(UsageError, match="angle"):
        merge(tmp_path / "nowhere", ["a"], "b", out, angle=30.0)
    points = np.eye(3)
    with pytest.raises(UsageError):
        merge(tmp_path / "nowhere", ["a"], "b", out, picked={("a", "c"): (points, points)})
    with pytest.raises(Refused, match="line"):
        line = np.outer([0, 1, 2], [1.0, 0, 0])
        merge(tmp_path / "nowhere", ["a"], "b", out, picked={("a", "b"): (line, line)})
    with pytest.raises(UsageError, match=r"\bb\b"):
        merge(tmp_path / "nowhere", ["b"], "b", out)
    with pytest.raises(UsageError, match=r"\.ply.*merged\.stl"):
        merge(tmp_path / "nowhere", ["a"], "b", out.with_suffix(".stl"))
