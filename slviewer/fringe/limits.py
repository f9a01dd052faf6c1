"""Limits for the validity of a pixel, shared by the NumPy definition and the kernels."""

DARK_LEVELS = 3.0
"""Modulation, in grey levels of 255, below which a pixel is DARK whatever its noise."""
DARK_SIGMAS = 4.0
"""Modulation in standard deviations of a grey level, below which a pixel is DARK: a Gray bit, whose
amplitude is at least the modulation, would flip in 1 pixel of 30,000 at this limit, and in 1 of 160
at 2.5."""
LEVEL_SIGMA = 0.15
"""Multi-frequency: standard deviation, in periods, of the step from one level to the next, above
which a pixel is DARK: at this limit the misfit that is refused below hides a wrong order in 1 pixel
of 15,000."""
DARK_BITS = 3
"""Gray code alone: undecided bits that make a pixel DARK; it receives scattered white light, but no
stripes."""

EDGE = 0.15
"""Part of a period on either side of a code edge within which a blurred bit may be read as its
neighbour's."""
WEAK_BIT = 0.35
"""A bit closer to the middle of black and white than this part of their half difference is on a
blurred edge."""
WEAKER = 0.5
"""... and only if it is closer by this factor than the bit of the cell's other edge."""
UNDECIDED_BIT = 0.15
"""A bit closer to its threshold than this part of the modulation, and away from its edges, is
undecided."""
GRAY_UNDECIDED_SIGMAS = 2.0
"""Gray code alone: a bit within this many of its own standard deviations of its threshold is
undecided."""
GRAY_UNDECIDED_PART = 0.05
"""... or within this part of the contrast: interreflected light alone makes such differences."""

LEVEL_MISFIT = 0.4
"""Multi-frequency: largest distance, in periods, between a coordinate and the one that the longer
period predicts."""

OUTSIDE_PX = 0.5
"""Noise that a coordinate at the projector's border is allowed before it counts as OUTSIDE."""

WINDOW = 2
"""Half the side of the neighbourhood that decides about spikes: 5 x 5 pixels."""
SPIKE_MAJORITY = 0.75
"""Part of the neighbours that must agree on one whole period before a pixel at a code edge is moved
by it: more than the two thirds outside the corner of an object."""
SPIKE_NEIGHBOURS = 8
"""Valid neighbours that such a majority needs."""
WHOLE_PERIOD = 0.25
"""How far, in periods, a difference may be from a whole period to count as a misread edge and not
as a depth step."""
LONELY = 0.4
"""A pixel that a smaller part of its neighbours agrees with is INCONSISTENT: less than a straight
edge of an object has (0.58), more than a line two pixels wide (0.38), in which the lens mixes the
light of two surfaces."""
LONELY_NEIGHBOURS = 3
"""A pixel with fewer valid neighbours than this is INCONSISTENT as well: nothing supports it."""
GRAY_CELL_PX = 16.0
"""Gray code alone has no period: neighbours that differ by less than half of this many px agree."""
GRAY_CELLS = 3.0
"""... or by less than half of this many cells: those on either side of a cell's border do."""
