"""How well each calibration measures target poses that it was not made from."""

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar

import msgspec

from slviewer.records.record import Count, Record
from slviewer.records.table import Cell, Column, Table


class HeldOutError(msgspec.Struct, frozen=True):
    """Errors of one model on boards that were not used to fit it, RMS where they are of several
    poses.

    ``plane_mm``: RMS distance of the board's pixels from their plane. ``board_mm``: RMS distance of
    the features from the board laid over them, flatness, shape and scale included. ``scale_ppm``:
    how much too long the board's own spacings come out. ``camera_px``, ``projector_px``: what
    ``board_mm`` amounts to in the images, RMS.
    """

    plane_mm: float
    board_mm: float
    scale_ppm: float
    camera_px: float
    projector_px: float


class HeldOutPose(HeldOutError, frozen=True):
    """Errors of one model on one pose, from so many ``pixels``."""

    pixels: Count
    depth_mm: float


class ModelComparison(Record, frozen=True, kw_only=True):
    """Target poses, each measured by calibrations that were made without it, all over the same
    pixels.

    ``models``: errors over all poses, the simplest model first; ``poses``: {model: {pose: its
    errors}}; ``folds``: poses held out together; ``failed``: {model: why it could not be fitted to
    some fold}; ``recommended``: the model with the least error on boards, of nearly equal ones the
    simplest.
    """

    kind: ClassVar[str] = "validation"
    title: ClassVar[str] = "Comparison of models"
    recommended: str
    models: Annotated[dict[str, HeldOutError], msgspec.Meta(min_length=1)]
    poses: dict[str, dict[str, HeldOutPose]]
    folds: tuple[tuple[str, ...], ...]
    failed: dict[str, str] = {}

    @classmethod
    def upgrade(cls, meta: Mapping[str, Any]) -> Mapping[str, Any]:
        """Convert a record of version 0.2, whose figures were one entry."""
        if not isinstance(old := meta.get("validation"), Mapping):
            return meta
        settings = {"models": list(old.get("models", {})), "folds": len(old.get("folds", ()))}
        inputs = meta.get("inputs", {})
        return {**old, "inputs": inputs, "operation": "validate", "settings": settings}

    def covers(self, models: Iterable[str]) -> bool:
        """Whether all of these models were compared."""
        return {*self.models, *self.failed}.issuperset(models)

    def summary(self) -> str:
        """Return the error of each model on boards, and the recommended model, in one sentence."""
        errors = ", ".join(f"{model} {each.board_mm:.3f} mm" for model, each in self.models.items())
        return f"held-out error of the models: {errors}; {self.recommended} is recommended"

    def figures(self) -> dict[str, float]:
        """Return none: to repeat it, every model is fitted again to each fold, which takes
        minutes."""
        return {}

    def list_tables(self, name: str) -> list[Table]:
        """Return a table of the errors with a line for each model; the least ones are marked."""
        columns = {
            "plane_mm": Column("plane", "mm", digits=4),
            "board_mm": Column("board", "mm", digits=4),
            "scale_ppm": Column("scale", "ppm", digits=0),
            "camera_px": Column("camera", "px"),
            "projector_px": Column("projector", "px"),
        }
        least = {
            figure: min(getattr(each, figure) for each in self.models.values())
            for figure in ("plane_mm", "board_mm", "camera_px")
            if len(self.models) > 1
        }
        rows = []
        for model, each in self.models.items():
            row: dict[Any, Cell] = {
                "model": Cell(model, "strong" if model == self.recommended else "")
            }
            for figure, column in columns.items():
                value = getattr(each, figure)
                row[column] = Cell(value, "better" if value == least.get(figure) else "")
            rows.append(row)
        count = len(next(iter(self.poses.values())))
        notes = [
            (
                f"{count} poses, each measured by calibrations without it ({len(self.folds)}"
                " folds). Plane: distance of the board's features from their plane; board: from"
                " their true positions."
            ),
            f"Recommended of these: {self.recommended}.",
            *(f"{model} could not be compared: {why}." for model, why in self.failed.items()),
        ]
        return [Table.of(rows, "RMS on held-out poses", notes)]
