"""A measured number with its unit and uncertainty."""

from dataclasses import dataclass
from typing import Literal

Unit = Literal["mm", "deg", "mm²", "%", ""]
COVERAGE = 2.0


@dataclass(frozen=True)
class Quantity:
    """A measured value. ``sigma``: its standard uncertainty (k = 1) in ``unit``, None where it has
    none (a residual, a count); ``U``: the expanded one (k = 2). ``whole``: whether they hold the
    calibration's part, which only the splined model knows; without it they are too small."""

    name: str
    value: float
    unit: Unit
    sigma: float | None = None
    whole: bool = True

    @property
    def U(self) -> float | None:
        """Expanded uncertainty, k = 2, in the quantity's unit."""
        return None if self.sigma is None else COVERAGE * self.sigma

    def format(self) -> str:
        """Return value ± U (k = 2) with the unit; a star where the calibration's part of U is
        unknown."""
        digits = 1 if self.unit == "%" else 3
        unit = {"deg": "°", "%": " %", "": ""}.get(self.unit, f" {self.unit}")
        # no minus before nothing
        value = f"{round(self.value, digits) + 0.0:.{digits}f}".replace("-", "−")
        U = "" if self.U is None else f" ± {self.U:.{digits}f}"
        return f"{value}{U}{unit}{'*' if U and not self.whole else ''}"
