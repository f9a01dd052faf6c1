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

    def text(self) -> str:
        """Format the quantity with its uncertainty for the terminal."""
        digits = 1 if self.unit == "%" else 4
        unit = {"deg": "°", "%": " %", "": ""}.get(self.unit, f" {self.unit}")
        if self.U is None:
            return f"{self.name} {self.value:.{digits}f}{unit}"
        part = "" if self.whole else ", without the calibration's part"
        return f"{self.name} {self.value:.{digits}f} ± {self.U:.{digits}f}{unit} (k = 2{part})"
