"""What the operator wants on the title page of reports: part, customer, order, operator,
temperature and logo; remembered in the session as the decision `report`."""

import base64
import io
from typing import Annotated

import msgspec

from slviewer.errors import InputError
from slviewer.records.record import from_plain, to_plain
from slviewer.session.names import clean_label

FIELDS = {
    "part": "Part",
    "customer": "Customer",
    "order": "Order",
    "operator": "Operator",
    "temperature_c": "Temperature",
}
"""Of the details but the logo, and what they are called."""
LOGO_PX = (480, 160)
"""Width and height that a logo is reduced to: twice the size at which pages show it."""
_LOGO_FORMATS = ("PNG", "JPEG", "WEBP")
_Text = Annotated[str, msgspec.Meta(max_length=200)]
_Base64 = Annotated[str, msgspec.Meta(max_length=1 << 19, pattern="^[A-Za-z0-9+/=]*$")]


class ReportDetails(msgspec.Struct, frozen=True, kw_only=True):
    """Details of the job that a report is about; empty or None where they are not stated.
    ``logo``: a WebP image as base64, as `encode_logo` returns it."""

    part: _Text = ""
    customer: _Text = ""
    order: _Text = ""
    operator: _Text = ""
    temperature_c: Annotated[float, msgspec.Meta(ge=-100, le=200)] | None = None
    logo: _Base64 = ""

    def clean(self) -> "ReportDetails":
        """Return the details without surplus space. Raises InputError for texts that are too long
        or cannot be printed, and for impossible temperatures."""
        plain = to_plain(self)
        texts = {name: clean_label(text) for name, text in plain.items() if isinstance(text, str)}
        return from_plain({**plain, **texts}, ReportDetails)

    def rows(self) -> dict[str, str]:
        """Return the details that are stated, with their units, by name."""
        t = self.temperature_c
        temperature = "" if t is None else f"{t:.4g} °C".replace("-", "−")
        texts = [temperature if f == "temperature_c" else getattr(self, f) for f in FIELDS]
        return {name: text for name, text in zip(FIELDS.values(), texts, strict=True) if text}


def encode_logo(name: str, content: bytes) -> str:
    """Return an image file's content as the ``logo`` of details. Raises InputError where it is no
    PNG, JPEG or WebP image."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content), formats=_LOGO_FORMATS) as image:
            image.thumbnail(LOGO_PX)
            buffer = io.BytesIO()
            image.convert("RGBA").save(buffer, "WEBP", quality=90)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise InputError(
            f"{name} cannot be read as a logo ({error})", "give a PNG, JPEG or WebP image"
        ) from error
    return base64.b64encode(buffer.getvalue()).decode()
