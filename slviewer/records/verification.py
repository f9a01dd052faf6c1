"""How far captures of known shapes are from these shapes."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from itertools import combinations
from math import dist
from statistics import fmean
from typing import Annotated, Any, Literal

import msgspec

from slviewer.records.record import (
    Cell,
    Column,
    Count,
    Meta,
    Record,
    Table,
    Vector,
    compare_with_first,
    format_scale,
    list_numbers,
    list_shares,
    to_plain,
)

Shape = Literal["plane", "sphere"]
MAX_EXCLUDED = 0.02
"""Share of points excluded above which the RMS does not describe the shape."""
REPORTED_MASKED = 0.005
"""Share of masked pixels from which on it is reported."""


class ModelFit(msgspec.Struct, frozen=True):
    """A shape fitted to the points of one model: ``excluded`` of the ``points`` lie beyond 5 robust
    sigma. Shares, 0 to 1: ``coverage`` of the illuminated pixels is measured, ``masked`` lie
    outside the calibrated region. A plane is ``normal . X = offset_mm``, a sphere has a radius and
    a centre, in the camera's frame."""

    points: Count
    excluded: Count
    rms_mm: float | None
    noise_floor_mm: float | None = None
    coverage: float | None = None
    radius_mm: float | None = None
    centre_mm: Vector | None = None
    normal: Vector | None = None
    offset_mm: float | None = None
    masked: float | None = None


class Verification(Record, frozen=True, kw_only=True):
    """Known shapes, measured by each model over the pixels that all of them measure. Every RMS
    stands beside its noise floor: what the capture's noise alone would give.

    Arrays: ``error_<model>`` (h, w) float32 mm, NaN where nothing was evaluated; positive towards
    the camera for a plane, outwards for a sphere. ``incidence``: percent of the shape in R1, R2 and
    R3. ``region_px``: first and last column, first and last row; ``share`` of the measured pixels
    lie in it.
    """

    kind = "verify"
    title = "Verification"
    shape: Shape
    models: Annotated[dict[str, ModelFit], msgspec.Meta(min_length=1)]
    incidence: dict[str, float] | None = None
    share: float | None = None
    region_px: tuple[int, int, int, int] | None = None
    warnings: tuple[str, ...] = ()

    @classmethod
    def upgrade(cls, meta: Meta) -> Meta:
        """Convert a record of version 0.2, whose models' entries were spread over the record."""
        if not {"centres_mm", "models", "shape"} <= meta.keys():
            return meta
        models = {name: dict(fit) for name, fit in meta["models"].items()}
        for name, fit in models.items():
            fit["excluded"] = fit.pop("set_aside")
            for key, old in (
                ("centre_mm", "centres_mm"),
                ("normal", "normals"),
                ("masked", "masked"),
            ):
                fit[key] = meta.get(old, {}).get(name)
        captures = [name for name in meta.get("inputs", {}) if "/" not in name]
        settings = {"captures": captures, "shape": meta["shape"], "models": list(models)}
        return {**meta, "models": models, "operation": cls.kind, "settings": settings}

    @property
    def rms_mm(self) -> dict[str, float]:
        """The RMS by model, NaN where it is unknown."""
        return {
            model: math.nan if fit.rms_mm is None else fit.rms_mm
            for model, fit in self.models.items()
        }

    @property
    def radii_mm(self) -> dict[str, float]:
        """The known radii by model."""
        fits = self.models.items()
        return {model: fit.radius_mm for model, fit in fits if fit.radius_mm is not None}

    @property
    def best(self) -> str:
        """The model with the smallest RMS."""
        return min(
            self.rms_mm, key=lambda model: (math.isnan(self.rms_mm[model]), self.rms_mm[model])
        )

    def summary(self) -> str:
        """Return the RMS of each model in one sentence."""
        return "RMS " + ", ".join(f"{model} {mm:.3f} mm" for model, mm in self.rms_mm.items())

    def figures(self) -> dict[str, float]:
        """Return the numbers of each model's fit."""
        return list_numbers(to_plain(self.models))

    @classmethod
    def tables(cls, found: Mapping[str, "Verification"]) -> list[Table]:  # type: ignore[override]
        """Return a table of the planes, one of the spheres, and one of the distances between their
        centres."""
        tables = []
        for shape, caption in (
            ("plane", "Planes: RMS distance from the best plane"),
            ("sphere", "Spheres: RMS and radius"),
        ):
            if of_shape := {name: each for name, each in found.items() if each.shape == shape}:
                tables.append(list_fits(of_shape, caption))
        if distances := centre_distances_mm(found):
            models = list(dict.fromkeys(model for each in distances.values() for model in each))
            rows = [
                {
                    "spheres": f"{a} to {b}",
                    **{Column(model, "mm"): each.get(model) for model in models},
                }
                for (a, b), each in distances.items()
            ]
            tables.append(Table.of(rows, "Distances between the centres of spheres"))
        return tables


def centre_distances_mm(
    found: Mapping[str, Verification],
) -> dict[tuple[str, str], dict[str, float]]:
    """Return {(name, name): {model: mm}}, the distances between the centres of each two spheres."""
    centres = {
        name: {
            model: fit.centre_mm for model, fit in each.models.items() if fit.centre_mm is not None
        }
        for name, each in found.items()
    }
    return {
        (a, b): {
            model: dist(centre, centres[b][model])
            for model, centre in centres[a].items()
            if model in centres[b]
        }
        for a, b in combinations([name for name, models in centres.items() if models], 2)
    }


def average(shape: Shape, found: Iterable[Verification]) -> Verification:
    """Return the means over verifications of the known figures of each model, and the sums of its
    points."""
    fits = defaultdict[str, list[ModelFit]](list)
    for each in found:
        for model, fit in each.models.items():
            fits[model].append(fit)
    return Verification(shape=shape, models={model: _average(of) for model, of in fits.items()})


def _average(fits: list[ModelFit]) -> ModelFit:
    """Return the means of the known figures, but of none that says where a shape lies, and the sums
    of the points."""
    means: dict[str, Any] = {}
    for figure in ModelFit.__struct_fields__:
        known = [value for fit in fits if (value := getattr(fit, figure)) is not None]
        if figure in ("points", "excluded"):
            means[figure] = sum(known)
        elif figure not in ("centre_mm", "normal", "offset_mm"):
            means[figure] = fmean(known) if known else None
    return ModelFit(**means)


def list_fits(found: Mapping[str, Verification], caption: str) -> Table:
    """Return the table of measured planes or spheres: a line for each capture and model."""
    first = next(iter(next(iter(found.values())).models))
    rows = []
    for name, each in found.items():
        for model, fit in each.models.items():
            compared = compare_with_first(each.rms_mm, model)
            excluded = fit.excluded / max(1, fit.points)
            is_best = model == each.best and len(each.models) > 1
            rows.append(
                {
                    "capture": name,
                    "model": model,
                    Column("RMS", "mm"): Cell(fit.rms_mm, "better" if is_best else compared.mark),
                    Column("noise floor", "mm"): fit.noise_floor_mm,
                    Column(f"against {first}", detail=True): compared,
                    Column("radius", "mm"): fit.radius_mm,
                    **list_shares(each.incidence),
                    Column("points", detail=True): fit.points,
                    Column("excluded", "%", digits=1): Cell(
                        100 * excluded, "worse" if excluded > MAX_EXCLUDED else ""
                    ),
                    Column("coverage", "%", digits=1): _percent(fit.coverage),
                    Column("masked", "%", digits=1, detail=True): _percent(fit.masked),
                }
            )
    return Table.of(rows, caption, _list_notes(found)).without_empty()


def _list_notes(found: Mapping[str, Verification]) -> list[str]:
    """Return what a reader of the table must know."""
    notes = [
        "Excluded: points beyond 5 robust sigma; above 2 % the RMS does not describe the shape."
        " Coverage: measured pixels of those illuminated and modulated."
    ]
    masked = [fit.masked for each in found.values() for fit in each.models.values()]
    if any(share is not None and share > REPORTED_MASKED for share in masked):
        notes.append(
            "Masked: pixels that look through parts of camera or projector that no target pose"
            " illuminated."
        )
    for name, each in found.items():
        notes += [f"{name}: {warning}" for warning in each.warnings]
        if each.region_px is not None:
            left, right, top, bottom = each.region_px
            share = (
                "" if each.share is None else f", {100 * each.share:.0f} % of the measured pixels"
            )
            notes.append(
                f"{name}: columns {left}-{right}, rows {top}-{bottom}{share}; coverage is of this"
                " region."
            )
    scaled = {
        model: factor
        for each in found.values()
        for model, factor in each.scales.items()
        if factor != 1
    }
    notes += [
        f"{model}: scale corrected by {format_scale(factor)}." for model, factor in scaled.items()
    ]
    return notes


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share
