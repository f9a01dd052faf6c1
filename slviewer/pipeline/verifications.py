"""The planes and spheres that a session has measured, as the wizard and the report show them."""

from collections.abc import Iterable, Mapping
from itertools import combinations
from typing import Any

import numpy as np

from slviewer.report.data import SpacingRow, VerificationView


def read_verification(capture: str, meta: Mapping[str, Any], label: str, stale: bool = False) -> VerificationView:
    """A result ``verify/<capture>`` of a session, without error maps; unknown figures are NaN."""
    figures = meta["models"]

    def by_model(key: str) -> dict[str, float]:
        """Return a figure of each model by the model's name; NaN where it is unknown."""
        return {m: np.nan if value[key] is None else float(value[key]) for m, value in figures.items()}

    return VerificationView(
        name=label,
        shape=meta["shape"],
        incidence=meta["incidence"] or {},
        points=max(int(measured["points"]) for measured in figures.values()),
        set_aside={model: int(measured["set_aside"]) for model, measured in figures.items()},
        coverage=by_model("coverage"),
        rms_mm=by_model("rms_mm"),
        noise_floor_mm=by_model("noise_floor_mm"),
        radius_mm=by_model("radius_mm"),
        masked=meta.get("masked", {}),
        capture=capture,
        stale=stale,
        centres_mm={model: np.array(centre) for model, centre in meta["centres_mm"].items()},
    )


def centre_spacings(views: Iterable[VerificationView]) -> list[SpacingRow]:
    """Return the distances between the centres of each two spheres by every model that measured both."""
    spheres = [view for view in views if view.centres_mm and not view.stale]
    return [
        SpacingRow(
            f"{a.name} to {b.name}",
            float("nan"),
            {m: float(np.linalg.norm(c - b.centres_mm[m])) for m, c in a.centres_mm.items() if m in b.centres_mm},
        )
        for a, b in combinations(spheres, 2)
    ]
