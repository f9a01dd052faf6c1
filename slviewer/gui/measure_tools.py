"""The tools of the step Measure, their instructions, and the points picked so far."""

from slviewer.inspection.regions import Region
from slviewer.pipeline.measured_surface import Place

PICK = ("Point", "Distance", "Section")
FIT = ("Plane", "Sphere", "Cylinder")
COMPARE = ("Relation", "Deviation")
_CLICKS = {
    "Point": ("Click the point.",),
    "Distance": ("Click the first point.", "Click the second point."),
    "Section": ("Click the start of the section.", "Click the end of the section."),
}
_WITHOUT_CLICKS = {
    "Relation": "Choose two points or fits, and measure their distances and angles.",
    "Deviation": "Choose or upload a nominal model (STL, PLY, OBJ, STEP, 3MF), and compare.",
}


class Tool:
    """The chosen tool, its name empty for none, the points picked with it, and the box drawn for a
    fit: by a rectangle where ``by_rectangle``, else fits use a ball about the picked point."""

    def __init__(self) -> None:
        self.name = ""
        self.picked: list[Place] = []
        self.by_rectangle = False
        self.box: Region | None = None

    def select(self, name: str) -> None:
        """Select another tool, or none; picked points and the box are dropped."""
        self.name, self.picked, self.box = name, [], None

    @property
    def has_region(self) -> bool:
        """Whether there is a region to fit to."""
        return self.fits and (self.box is not None if self.by_rectangle else bool(self.picked))

    @property
    def fits(self) -> bool:
        """Whether the tool fits a shape to a region around the picked point."""
        return self.name in FIT

    @property
    def clicks(self) -> bool:
        """Whether the tool needs clicks on the surface."""
        return self.fits or self.name in _CLICKS

    def pick(self, place: Place) -> tuple[Place, ...] | None:
        """Add a click on the surface; returns all points once the tool has enough, and starts
        again.

        A tool that fits replaces its point instead, until the operator accepts the region. The same
        point again, as by a double click, is not a second point.
        """
        if self.fits:
            self.picked = [place]
            return None
        if place in self.picked:
            return None
        self.picked.append(place)
        if len(self.picked) < len(_CLICKS.get(self.name, ())):
            return None
        done, self.picked = tuple(self.picked), []
        return done

    @property
    def instruction(self) -> str:
        """What to do now, in one sentence."""
        if not self.name:
            return "Choose a tool."
        if self.fits:
            shape = self.name.lower()
            if self.by_rectangle:
                end = f", then press Fit {shape}." if self.box is not None else "."
                return f"Drag a rectangle over the {shape} alone{end}"
            if not self.picked:
                return f"Click the centre of the {shape}."
            return (
                f"Set the radius so that the ball contains only the {shape}, then press Fit"
                f" {shape}."
            )
        if self.name in _WITHOUT_CLICKS:
            return _WITHOUT_CLICKS[self.name]
        return _CLICKS[self.name][len(self.picked)]
