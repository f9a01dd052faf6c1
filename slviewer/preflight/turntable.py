"""Does the turntable answer, turn, and come back?"""

from slviewer.devices.protocols import Turntable, report_driver_faults
from slviewer.errors import DeviceError, InputError
from slviewer.pipeline.examination import Check
from slviewer.preflight.order import format_sentence

_TURN_DEG = 2.0
_TOLERANCE_DEG = 0.2


def check_turning(table: Turntable) -> Check:
    """Open the turntable, turn it by 2 degrees and back, and close it."""
    figures: dict[str, float] = {}
    try:
        with report_driver_faults(table):
            table.open()
            try:
                begin_deg = table.position_deg()
                low, high = table.limits_deg or (-float("inf"), float("inf"))
                turned_deg = (
                    begin_deg + _TURN_DEG
                    if begin_deg + _TURN_DEG <= high
                    else max(low, begin_deg - _TURN_DEG)
                )
                table.turn_to(turned_deg)
                error_deg = table.position_deg() - turned_deg
                table.turn_to(begin_deg)
                figures = {"position_deg": round(begin_deg, 3), "error_deg": round(error_deg, 3)}
            finally:
                table.close()
    except (InputError, DeviceError) as error:
        remedy = format_sentence(error.remedy)
        return Check("turntable", "bad", f"{error.observation}.", remedy, figures)
    if abs(error_deg) > _TOLERANCE_DEG:
        sentence = f"{table.name} stops {error_deg:+.2f} degrees off."
        return Check(
            "turntable",
            "warning",
            sentence,
            "Check degrees_per_unit and the controller's steps.",
            figures,
        )
    return Check("turntable", "good", f"{table.name} turns, and comes back.", "", figures)
