"""The tools of the step Measure: which there are, what each asks for now, and what was clicked so far."""

from slviewer.pipeline.measured_surface import Place

PICK = ("Point", "Distance", "Section")
FIT = ("Plane", "Sphere", "Cylinder")
COMPARE = ("Two results", "Nominal model")
_CLICKS = {
    "Point": ("Click the point.",),
    "Distance": ("Click the first point.", "Click the second point."),
    "Section": (
        "Click where the cut begins.",
        "Click where it ends: it goes through both points and, as nearly as can be, through the camera.",
    ),
}
_REST = {
    "Two results": "Choose two points or fits, and press Measure between them.",
    "Nominal model": "Upload the model (STL, PLY, OBJ) or choose one, give the limit, if any, and press Compare.",
}


class Tool:
    """The tool in hand, its name empty where there is none, and the places that were picked with it."""

    def __init__(self) -> None:
        self.name = ""
        self.picked: list[Place] = []

    def take(self, name: str) -> None:
        """Take another tool, or none, in hand; what was picked is forgotten."""
        self.name, self.picked = name, []

    @property
    def fits(self) -> bool:
        """Whether it fits a shape to a region around the picked place."""
        return self.name in FIT

    @property
    def clicks(self) -> bool:
        """Whether it waits for clicks on the surface."""
        return self.fits or self.name in _CLICKS

    def pick(self, place: Place) -> tuple[Place, ...] | None:
        """A click on the surface; all the places where with it the tool has what it needs, and begins anew.

        A tool that fits keeps the last one instead, until the operator is content with the region.
        """
        if self.fits:
            self.picked = [place]
            return None
        self.picked.append(place)
        if len(self.picked) < len(_CLICKS.get(self.name, ())):
            return None
        done, self.picked = tuple(self.picked), []
        return done

    @property
    def sentence(self) -> str:
        """What to do now."""
        if not self.name:
            return "Choose a tool."
        if self.fits:
            shape = self.name.lower()
            if not self.picked:
                return f"Click the middle of the {shape}."
            return (
                f"Set the radius so that the ball holds nothing but the {shape}, and press Fit {shape}; or click "
                "elsewhere."
            )
        if self.name in _REST:
            return _REST[self.name]
        return _CLICKS[self.name][len(self.picked)]
