"""Check of the description of a capture against its frames, and search for a description or frame
order that fits.

A hypothesis is accepted if it passes a test that the description fails: code edges obey the Gray
code, have one phase of the fringes, and the phase rises with the code; each fringe period predicts
the next finer one; coordinates are inside the projector and are not a mirror image of the scene.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slviewer.fringe.agreement_tests import failed_tests, is_proven, sum_shares
from slviewer.fringe.axis_agreement import Agreement, estimate_coordinates, measure_agreement
from slviewer.fringe.axis_reader import AxisFrames, AxisReader, described_frames
from slviewer.fringe.contradiction import Contradiction
from slviewer.fringe.description_change import CLEARLY, LINES, explain_axis
from slviewer.fringe.frame_light import (
    FrameLight,
    describe_disturbance,
    equalize_frames,
    estimate_frame_light,
)
from slviewer.fringe.frame_likeness import FrameLikeness
from slviewer.fringe.frame_order import StepReader, detect_copies, search_order
from slviewer.fringe.layout import check_stack
from slviewer.fringe.line_sample import LineSample, coded_frames, grid_sample, sample_lines
from slviewer.fringe.sequence import Axis, PatternSequence

LEAST_ILLUMINATED = 0.005
"""Share of the pixels that must carry a pattern."""
MOSTLY = 0.5
APART = 6
"""Distance, in pixels of the grid, at which coordinates are compared: several cells of the code."""
FEWEST_TURNS = 100
MAX_CLIPPED = 0.05
"""Mean share of saturated values at illuminated pixels beyond which bits and fringes are unreadable
in places."""
UNSTEADY = 0.1
"""Relative rms of the mean brightness of phase steps from which the light is unsteady; incomplete
fringes give less."""
SUDDENLY = 0.2
"""Share of saturated values before a frame, relative to that from it on, below which the light has
changed suddenly."""
_OF_STEPS = ("duplicate-frame", "frame-order", "step-order")
MIRRORED = 0.8
"""Share of mirrored pixels from which an axis is reversed; a smaller share is due to noise and
depth steps."""


@dataclass(frozen=True, eq=False)
class FrameReadings:
    """What the checks read in the (n, h, w) ``stack`` of a capture: computed when first used, and
    then cached."""

    sequence: PatternSequence
    stack: np.ndarray

    @cached_property
    def sample(self) -> LineSample:
        """Rows and columns of the frames."""
        return sample_lines(self.sequence, self.stack)

    @cached_property
    def readers(self) -> dict[Axis, AxisReader]:
        """The reader of each axis."""
        return {
            axis: AxisReader(self.sample, coded_frames(self.sequence, axis))
            for axis in self.sequence.axes
        }

    @cached_property
    def likeness(self) -> FrameLikeness:
        """The comparison of the frames with each other."""
        return FrameLikeness(self.sequence, self.sample)

    @cached_property
    def steps(self) -> StepReader:
        """The check of the phase steps."""
        return StepReader(self.sequence, self.sample)

    @cached_property
    def copies(self) -> tuple[Contradiction, ...]:
        """Contradictions of frames that repeat others; empty if none do."""
        return detect_copies(self.sequence, self.readers, self.likeness)

    @cached_property
    def stated(self) -> dict[Axis, Agreement]:
        """How well the frames of each axis agree under the description."""
        return {
            axis: measure_agreement(reader, described_frames(self.sequence, axis))
            for axis, reader in self.readers.items()
        }

    @cached_property
    def mirroring(self) -> tuple[Contradiction, ...]:
        """The contradiction of axes that are exchanged or reversed; empty if the coordinates are
        not mirrored."""
        return _detect_mirroring(self.sequence, self.sample)


def check_description(
    sequence: PatternSequence, stack: np.ndarray, readings: FrameReadings | None = None
) -> tuple[Contradiction, ...]:
    """Return the contradictions between the description of an (n, h, w) stack and its frames, the
    most probable first.

    The result is empty where the description holds. Some rows and columns are read, weighted by
    modulation; frames of unequal light are compared as they would be under equal light.
    ``readings``: of the stack, new ones if None. Raises InputError for a stack that does not match
    the sequence.
    """
    check_stack(sequence, stack)
    readings = readings or FrameReadings(sequence, stack)
    contradictions = find_contradictions(readings)
    if not contradictions:
        return ()
    light = estimate_frame_light(sequence, stack)
    if light.is_significant:
        under_equal_light = find_contradictions(
            FrameReadings(*equalize_frames(sequence, stack, light)[:2])
        )
        is_explained = all(contradiction.cause != "unreadable" for contradiction in contradictions)
        # Misplaced frames distort the estimate of the light: an explanation of the frames as they
        # are has priority.
        if not under_equal_light or not is_explained:
            contradictions = under_equal_light
    causes = {contradiction.cause for contradiction in contradictions}
    if not causes or causes - {"unreadable", "duplicate-frame"}:
        return contradictions
    return _explain_by_light(readings, light) or contradictions


def _explain_by_light(readings: FrameReadings, light: FrameLight) -> tuple[Contradiction, ...]:
    """Return the contradiction of saturated frames, or of unsteady light; empty if neither explains
    the frames."""
    sequence, sample = readings.sequence, readings.sample
    coded = coded_frames(sequence)
    illuminated = sample.swing(coded) > sample.least_swing
    clipped = np.array(
        [float(np.mean(sample.frames[i][illuminated] >= sample.white)) for i in coded]
    )
    saturated = _describe_saturation(coded, clipped) if np.mean(clipped) > MAX_CLIPPED else None
    unsteady = _measure_unsteadiness(sequence, sample, illuminated)
    terms = light.terms or light.unexplained
    if unsteady > UNSTEADY and terms and not (saturated and saturated.cause == "room-light"):
        return (Contradiction(*describe_disturbance(terms), None, unsteady),)
    return (saturated,) if saturated else ()


def _describe_saturation(coded: list[int], clipped: np.ndarray) -> Contradiction:
    """Return the contradiction for saturated frames, or for room light that saturates them from one
    frame on.

    ``clipped``: share of saturated pixels in each of the ``coded`` frames, among the illuminated
    pixels.
    """
    later = range(2, len(coded) - 1)
    k = max(later, key=lambda k: float(np.median(clipped[k:]) - clipped[:k].max()), default=0)
    if k and clipped[:k].max() < SUDDENLY * np.median(clipped[k:]):
        text = (
            f"from frame {coded[k] + 1} on {100 * np.mean(clipped[k:]):.0f} % of the illuminated"
            " pixels are saturated, and hardly any before: the light of the room changed; keep it"
            " constant, or switch it off, and lower the exposure"
        )
        return Contradiction("room-light", text, None, float(coded[k]))
    share = 100 * float(np.mean(clipped))
    text = (
        f"{share:.0f} % of the illuminated pixels are saturated in the mean of the frames: lower"
        " the exposure or the gain, and capture again"
    )
    return Contradiction("saturation", text, None, share)


def _measure_unsteadiness(
    sequence: PatternSequence, sample: LineSample, illuminated: np.ndarray
) -> float:
    """Return the largest relative rms of the mean brightness of the phase steps of one period.

    Under equal light the mean brightness is the same in all steps, whatever their order, as long as
    several fringes are in view. ``illuminated`` (p,): mask of the sampled pixels to average.
    """
    worst = 0.0
    for axis in sequence.axes:
        for _, steps in sequence.phase_shifts(axis)[-1:]:
            means = [float(sample.frames[i][illuminated].mean()) for i in steps]
            worst = max(worst, float(np.std(means)) / max(float(np.mean(means)), 1e-6))
    return worst


def find_contradictions(
    readings: FrameReadings, *, with_steps: bool = True
) -> tuple[Contradiction, ...]:
    """Return the contradictions of frames as they are, assuming equal light; see
    `check_description`.

    ``with_steps``: also check the order of the phase steps within each period.
    """
    sequence = readings.sequence
    if not sequence.axes:
        return ()
    if found := _detect_missing_pattern(sequence, readings.sample) or readings.copies:
        return found
    failed = {
        axis: failed_tests(described_frames(sequence, axis), a)
        for axis, a in readings.stated.items()
    }
    disordered, strange = _check_steps(readings) if with_steps else ([], set())
    uneven = _detect_uneven_frames(readings)
    if not (any(failed.values()) or disordered or strange or uneven):
        return readings.mirroring
    if disordered and all(contradiction.cause in _OF_STEPS for contradiction in disordered):
        return tuple(disordered)  # steps of one period, which are explained completely
    if found := _detect_exchanged_axes(sequence, readings.sample, failed):
        return found
    return _explain_failed_tests(
        readings, failed, disordered, uneven, not (disordered or strange or uneven)
    )


def _explain_failed_tests(
    readings: FrameReadings,
    failed: dict[Axis, set[str]],
    disordered: list[Contradiction],
    uneven: list[Contradiction],
    is_ordered: bool,
) -> tuple[Contradiction, ...]:
    """Return the changes of the description, or the order of the frames, that explain the
    ``failed`` tests best.

    ``disordered``, ``uneven``: contradictions of the phase steps, and of white and black frames;
    ``is_ordered``: whether all frames are in their place.
    """
    sequence, stated = readings.sequence, readings.stated
    answers = {
        axis: explain_axis(readings.readers[axis], sequence, axis)
        for axis in sequence.axes
        if failed[axis]
    }
    complete = is_ordered and all(answers.values())
    if not (complete and all(found[0].is_certain for found in answers.values())):
        explained = [
            answers[axis][0].score if answers.get(axis) else sum_shares(stated[axis])
            for axis in sequence.axes
        ]
        order = search_order(
            sequence, readings.readers, readings.steps, readings.likeness, disordered
        )
        if order is not None and not (complete and sum(explained) > order.score - CLEARLY):
            return order.contradictions
    out = list(disordered)
    for axis, found in answers.items():
        if found:
            out += [contradiction for answer in found for contradiction in answer.contradictions]
        elif not disordered:
            out.append(_describe_failed_tests(axis, stated[axis], failed[axis]))
    return tuple(dict.fromkeys(out + uneven))


def _check_steps(readings: FrameReadings) -> tuple[list[Contradiction], set[int]]:
    """Return the contradictions of phase steps out of order, and, without any, the frames that no
    step explains."""
    steps = readings.steps
    disordered = [c for axis in readings.sequence.axes for c in steps.detect_misplaced_steps(axis)]
    return disordered, set() if disordered else steps.detect_unexplained_steps()


def _detect_uneven_frames(readings: FrameReadings) -> list[Contradiction]:
    """Return the contradictions of white and black frames that are not."""
    out = []
    for i, frame in enumerate(readings.sequence.frames):
        if not readings.likeness.is_even(i, i):
            text = (
                f"frame {i + 1} should be {frame.kind}, and is not: put the frames in order, or"
                " capture again"
            )
            out.append(Contradiction("frame-order", text, None, float(i)))
    return out


def _detect_missing_pattern(
    sequence: PatternSequence, sample: LineSample
) -> tuple[Contradiction, ...]:
    """Return the contradiction of a capture that is dark, saturated or shows no pattern; empty if
    it shows one."""
    grid = sample.grid[coded_frames(sequence)].astype(np.float32)
    high, low = grid.max(axis=0), grid.min(axis=0)
    share = float(np.mean(high - low > sample.least_swing))
    if share >= LEAST_ILLUMINATED:
        return ()
    clipped, modulation = (
        float(np.mean(low >= sample.white)),
        float(np.quantile(high - low, 0.99)) / 2,
    )
    text = f"{100 * share:.1f} % of the pixels carry a readable pattern"
    if clipped > MOSTLY:
        remedy = "lower the exposure or the gain, and capture again"
        text += f", and {100 * clipped:.0f} % are saturated in all frames: {remedy}"
        return (Contradiction("saturation", text, None, clipped),)
    text += (
        f"; the modulation is {modulation:.1f} of {sample.white:.0f} grey levels: raise the"
        " exposure or the projector's brightness, and check that the projector showed the patterns"
    )
    return (Contradiction("dark", text, None, modulation),)


def _detect_exchanged_axes(
    sequence: PatternSequence, sample: LineSample, failed: dict[Axis, set[str]]
) -> tuple[Contradiction, ...]:
    """Return the contradiction of exchanged axes, in all frames, or in phase steps or Gray bits
    only.

    Accepted if both axes pass all tests with the frames of the other axis; empty if they do not.
    """
    if len(sequence.axes) < 2 or not any(failed.values()):
        return ()
    reader = AxisReader(sample, coded_frames(sequence))
    x, y = (described_frames(sequence, axis) for axis in ("x", "y"))
    steps = [[(period, len(images)) for period, images in frames.shifts] for frames in (x, y)]
    can_differ = (
        x.bits and y.bits and steps[0] and steps[0] == steps[1] and len(x.bits) == len(y.bits)
    )
    for which in ("frames", "phase steps", "Gray frames") if can_differ else ("frames",):
        variants = [_exchange_frames(own, other, which) for own, other in ((x, y), (y, x))]
        if not all(is_proven(variant, measure_agreement(reader, variant)) for variant in variants):
            continue
        if which == "frames":
            return (
                _describe_exchanged_axes(
                    "the codes along x fit the projector's rows, and those along y its columns"
                ),
            )
        text = (
            f"x and y are exchanged in the {which} alone, which fit the other frames of the other"
            f" axis: exchange the {which} of x and y in the description"
        )
        return (Contradiction("axes-swapped", text, None, None),)
    return ()


def _exchange_frames(own: AxisFrames, other: AxisFrames, which: str) -> AxisFrames:
    """Return the frames of an axis with all "frames", the "phase steps", or the "Gray frames" of
    the other axis."""
    if which == "frames":
        return replace(other, extent=own.extent)
    if which == "phase steps":
        return replace(own, shifts=other.shifts)
    return replace(own, bits=other.bits, inverse=other.inverse)


def _describe_exchanged_axes(observation: str) -> Contradiction:
    """Return the contradiction of exchanged axes, from the observation that shows it."""
    text = (
        f"{observation}: x and y are exchanged; exchange the x and y (V and H) frames in the"
        " description"
    )
    return Contradiction("axes-swapped", text, None, None)


def _detect_mirroring(sequence: PatternSequence, sample: LineSample) -> tuple[Contradiction, ...]:
    """Return the contradiction of axes that are exchanged or reversed; empty if the coordinates are
    not mirrored.

    Camera and projector both see the scene from the front, so that neither sees a mirror image.
    """
    if len(sequence.axes) < 2:
        return ()
    grid = grid_sample(sample)
    shape = sample.grid.shape[1:]
    u, v = (
        estimate_coordinates(
            AxisReader(grid, coded_frames(sequence, axis)), described_frames(sequence, axis)
        ).reshape(shape)
        for axis in sequence.axes
    )
    here, right, below = np.s_[:-APART, :-APART], np.s_[:-APART, APART:], np.s_[APART:, :-APART]
    ux, uy, vx, vy = u[right] - u[here], u[below] - u[here], v[right] - v[here], v[below] - v[here]
    turn = ux * vy - uy * vx
    known = np.isfinite(turn) & (turn != 0)
    if np.count_nonzero(known) < FEWEST_TURNS:
        return ()
    share = float(np.mean(turn[known] < 0))
    if share < MIRRORED:
        return ()
    observation = (
        f"the projector's coordinates are a mirror image of what the camera sees ({100 * share:.0f}"
        " % of the pixels)"
    )
    along, across = (float(np.median(np.abs(a[known]))) for a in (ux, uy))
    if across > along:  # devices that stand upright
        return (_describe_exchanged_axes(observation),)
    reversed_x = float(np.median(ux[known])) < 0
    axis: Axis = "x" if reversed_x else "y"
    cure = (
        f"number the projector's {LINES[axis]} from the other end, or switch off its mirror or rear"
        " mode"
    )
    out = [
        Contradiction(
            "axis-reversed", f"{observation}, as if axis {axis} were reversed: {cure}", axis, None
        )
    ]
    if not sequence.find("gray", axis):
        sign = -sequence.sign(axis)
        text = (
            f"{observation}, as if the phase of axis {axis} ran backwards: set phase_sign = {sign}"
            f" for axis {axis}"
        )
        out.insert(0, Contradiction("step-order", text, axis, float(sign)))
    return tuple(out)


def _describe_failed_tests(axis: Axis, a: Agreement, failed: set[str]) -> Contradiction:
    """Return the contradiction that reports the failed tests of an axis where no hypothesis
    explains them."""
    observations = (
        (
            {"bits"},
            (
                f"Gray bit {a.unreadable} of axis {axis} cannot be read though its stripes should"
                " be wide"
            ),
        ),
        (
            {"inverse"},
            (
                f"a Gray bit of axis {axis} and its inverse are alike at"
                f" {100 * (1 - a.opposed):.0f} % of the pixels"
            ),
        ),
        (
            {"rule"},
            (
                f"a Gray bit of axis {axis} contradicts the other bits at {100 * (1 - a.rule):.0f}"
                " % of its edges"
            ),
        ),
        (
            {"common", "rising", "cell"},
            (
                f"Gray code and fringes of axis {axis} do not fit together: the code's edges fall"
                " at no common phase"
            ),
        ),
        ({"levels", "level offset"}, f"the fringe periods of axis {axis} contradict each other"),
        (failed, f"{100 * a.outside:.0f} % of the {axis} codes lie outside the projector"),
    )
    observation = next(text for tests, text in observations if failed & tests)
    text = (
        f"{observation}, and no other order, numbering or size of the frames explains it: check"
        " that all frames belong to one capture, that nothing moved, and the periods, steps and"
        " bits of the description"
    )
    return Contradiction("unreadable", text, axis, None)
