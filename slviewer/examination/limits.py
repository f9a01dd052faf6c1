"""Numbers that the examination of captures decides by, and where each comes from.

"Measured" means on the sound and faulty captures of `python -m tests.proofs causes`, and on
photographs of real rigs.
"""

CENTRES = 6_000
"""Pixels of the grid that samples are chosen from: 60 x 100 of an image."""
EVEN, PER_FRAME = 700, 40
"""Pixels chosen evenly, whose mean is known to 4 %, and at the edges of each frame."""
COARSE = 6
"""A small sample, which ranks hypotheses, has this part of the pixels."""
ALONE = 48
"""Pixels that are matched alone, to leave hypotheses out before the small sample ranks them."""
REACH_PX = 4
"""Distance of a neighbour: twice the blur of a camera in focus, less than the finest fringe."""
VARIES = 1.5
"""Mean difference of a pixel's neighbours over the noise, that noise alone leaves at 1.1."""
STEEP = 0.4
"""Change between a pixel's neighbours, as a share of its range, at an edge: noise makes less."""
DARK_SHARE, DARK_SIGMAS = 6 / 255, 8.0
"""Range of a pixel's levels, of full scale and in standard deviations of noise, that shows a
pattern: in fifty frames of noise alone the range stays below seven in 99.99 % of the pixels."""
FEW_FRAMES = 5
"""Frames below which a pixel's range is that of all its levels: of five phase steps, the second
largest and the second smallest differ by 0.56 of the range at least, of four by nothing."""
OFTEN_CLIPPED = 0.1
"""Share of the frames in which a pixel is saturated, from which it is not used."""
FEWEST_IMAGES = 4
"""Three levels fit any three images."""
FEWEST_PIXELS = 60
"""Below, the mean misfit of a sample is known to no better than 15 %."""
LEAST_LIT = 0.005
"""Share of the image that must carry a pattern: half a percent is a board in a corner."""
MOSTLY = 0.3
"""Share of the image saturated too often, from which saturation is why no pattern shows."""

STEPS_PER_PERIOD = 18
"""Coordinates at which patterns are tabulated: between them a cosine is off by 0.4 %."""
BEYOND = 1.25
"""Range of coordinates over the projector's size: beyond, beats of fine periods repeat."""
FAR_BEYOND = 1.7
"""The same where beats are longer: a projector may be larger than described."""
BEYOND_CODE = 2.2
"""The same of a Gray code, whose cells may be half as wide as described."""
NEAR = 6
"""Steps of the table, a third of a period, within which two neighbours' coordinates join."""
FREQUENT = 0.3
"""Frequency of a distance between two neighbours' coordinates over the most frequent one's, from
which it may be the right one: where two places fit, a wrong one is found twice as often at most."""
UNDECIDED = 0.6
"""Share of one bit's variance that a pixel on the bit's edge leaves open: it is half bright."""
CONTRASTS = (0.25, 1.5)
"""Contrast of fringes over that of wide stripes: least that decodes, and most that gamma adds."""
BLURS = (0.0, 1.0, 1.5, 2.0, 3.0, 4.0, 5.5, 7.5)
"""Standard deviations of the blur of stripes that are tried, in steps of the table."""
FITS_OF_GROUPS, VARIED_STRIPES = 2, 0.05
"""Fits of the periods' contrasts and of each pixel's, in turns; and variance of stripes, of 0.25 at
most, from which they give the scale."""
GOOD = 0.3
"""Misfit, 1 - correlation^2, of a pixel that is explained: blur and gamma 2.2 leave 0.15."""
LEAST_CONTRAST = 0.15
"""Contrast over the range of a pixel's levels, below which the prediction misses them."""

SMALL_LOSS, STANDS_OUT, STANDS_OUT_LEAST = 0.03, 2.5, 0.01
"""Mean misfit, and residual of a frame over the median of its kind and squared contrast beyond it,
up to which nothing is searched: measured, no fault that harms stays below all."""
AGREEING = 0.3
"""Mean cosine of the distance between two periods' coordinates, in the shorter period, below which
something is searched for: where they agree it is 1, at random 0, and -1 for half a period."""
GROWING, GROWN = 0.05, 0.4
"""Growth of this distance over the view that gamma does not leave; and distance to which it grows
from the projector's first column, at which whole periods may be wrong."""
REPEATED = 0.06
"""Mean squared difference, in squares of the range, up to which an image repeats another, also with
a fifth of the next one in it; those of eight phase steps differ by 0.07, of fewer by more."""
SAME = 1e-6
"""... and the one below which it is the same image: noise alone differs by more."""
KEPT = 8
"""Hypotheses that are compared on all pixels, of those that the small sample ranks best."""
SIGMAS = 5.0
"""Standard errors by which a hypothesis must explain more: one in two million by chance."""
MOST_SKEWED = 1.5
"""Factor by which the error of a gain that only a part of the pixels show is smaller than by their
deviation: a dozen pixels are needed for it to be significant."""
MAJORITY = 0.5
"""Share of the pixels that an image which shows something else must mislead; measured, it misleads
from 0.58, and edges of surfaces and of beats leave 0.43."""
NARROW = 3.0
"""Width of a cell, px of the camera, below which its bit is not predicted from its neighbours."""
LEAST_SHARE = 0.3
"""The same of the pixels that another description must explain better, and a strange image by a
tenth of the mean: what explains edges alone does so for 0.06, what is wrong for 0.6 and more."""
SIGMAS_CONFIRMED, NEARLY_ALL = 3.0, 0.9
"""The same of one hypothesis that other evidence asks for, one in 700 by chance: coordinates that
run in an impossible direction, frames' means that drift, and such a share of the pixels."""
EXPLAINED = 0.25
"""Share of the misfit that it must explain, or ..."""
LEFT_OF_FRAMES = 0.6
"""... of the residual of the frames that it moves that may be left: noise is."""
LEFT_BESIDE = 0.25
"""Misfit of all images that may be left beside few frames which a hypothesis moves: images in a
random order left 0.46 where two of them were exchanged."""
LEFT_BY_EXPLAINING = 0.25
"""Share of the misfit that a hypothesis may leave beside which only those are tried that leave as
little of pixels matched alone; measured, frames out of order leave 0.17 at most."""
EXPLAINED_BY_MOTION = 0.05
"""The same of motion, to which the projector's response and blur leave much: measured, motion
explains nothing of sound captures."""
LEFT_OF_EACH = 0.9
"""The same of each of two frames that have changed places."""
RIVAL = 0.5
"""Share of the best gain, from which a frame is a rival for the one that shows something else."""
LEFT_OF_RIVAL, LEFT_LEAST = 2.0, 0.01
"""Share of what the best explanation leaves, and misfit beyond it, that another one may leave to be
preferred for accounting for all images."""
STRANGE, STRANGE_LEAST = 3.0, 0.005
"""Residual of such a frame over the median of the others, and least squared contrast of it."""
HALF_LEFT = 0.5
"""Share of the misfit up to which an order that loses an image is the reason of coordinates that
cannot be."""
WHOLE = 0.005
"""Distance of a period, as a share, from one of a whole number of fringes across the projector."""
LEFT_ALIKE = 0.002
"""Misfit by which explanations are alike: a strange image among fifty leaves five times as much."""
SIGMAS_OF_RIVAL = 3.0
"""Standard errors by which one frame that shows something else must explain all images better than
another one."""
AS_LITTLE = 1.25
"""Factor of the misfit of a hypothesis that a remedy with a rounded value may leave; and of one
that leaves an image out, that light may leave which accounts for all."""
STRANGE_SHARE, VERY_STRANGE = 0.1, 0.15
"""Share of the misfit that its absence must remove, or squared contrast of its residual: the
harmonics of a clipped cosine stay below both."""
UNRESOLVED = 0.35
"""Contrast of stripes, relative to wide ones, below which the camera does not resolve them."""
COPY, COPY_NOISE = 0.1, 1.5
"""Squared difference of two images over the usual one of neighbouring steps, and over twice the
noise beside it, of an image that is handed out twice."""
CONCENTRATED = 0.7
"""Resultant of the phases, above which they cover less than about half of the period."""
UNREADABLE, WEAK = 0.5, 16.0
"""Misfit that no hypothesis lowers, with which nothing can be measured; and range of levels in
standard deviations of noise, below which noise is the reason."""
FLAT, ALIKE = 0.175, 0.4
"""Rms distance from grey, and correlation with the pattern, of stripes that blur has closed."""
MISPLACED, MISPLACED_LEAST = 2.0, 0.003
"""Residual of a phase step over the median of its period, and squared contrast beyond it, from
which other steps are tried: of 18 steps a neighbour's has 0.06."""
UNLIKE_ANY, UNLIKE_ANY_LEAST = 6.0, 0.05
"""The same of a step that shows no pattern of its axis."""
MOST_SINGLE = 3
"""Single frames named; more have a common cause."""

PER_FRAME_COST, CHANGE_COST = 1e-4, 1e-3
"""Misfit that a hypothesis costs for each frame that it moves, and each value that it changes: of
equal explanations the simplest is chosen."""
LOST_COST = 1e-3
"""The same for a missing image, which may be any."""
MIRRORED_COST, TURNED_COST, FOLDED_COST = 0.02, 0.002, 0.02
"""The same for coordinates that are a mirror image of what the camera sees, which no device shows;
for a projector upside down, which is rare; and for an axis that runs backwards from neighbour to
neighbour, or beyond the projector."""

OUTSIDE = 0.08, 0.02
"""Share of the coordinates beyond the projector, that noise of fine periods does not reach, and
that wrong bits of a Gray code do not."""
FEWEST_AT_EDGES = 15
"""Pixels at edges of stripes, from which the displacement of a frame is known."""
PAIR_SIGMAS = 3.0
"""Standard errors, by their scatter, by which pairs of a bit and its inverse must move as well."""
LEAST_MOTION = 0.015
"""Displacement from the first to the last step, in periods, that gamma and noise do not imitate."""
JUMP_SHARE, JUMP_EXPLAINS, JUMP_SIGMAS, MOST_JUMP = 0.7, 0.5, 10.0, 0.2
"""The same of a displacement between two steps: its share of the steps' variance, and of the
residual of the displaced steps; its standard errors, and periods that a step which shows another
pattern exceeds. Measured, long periods of sound captures jump by at most 6 standard errors."""
JUMP_OF_STRIPES = 0.9, 0.1
"""Share of the variance, and of a cell, from which stripes show a jump although no bit was captured
before it and its inverse after it, and the share of a cell from which they show a steady motion;
measured, blur and gamma reach 0.06 of a cell where bits are resolved, and motion from 0.15."""
STEADY_OF_STRIPES = 0.5
"""Share of the displacements of stripes that a steady motion explains at least; measured, motion
explains from 0.57, and stripes that are not resolved imitate one that explains 0.33."""
MUCH_MOTION = 0.03
"""The same, from which a capture must not be measured: a fringe is read to a hundredth."""
USUAL_OFFSET = 0.02
"""Periods by which an offset of the phase may differ from a quarter or a step."""
LEAST_GHOST, GHOST_SIGMAS = 0.02, 5.0
"""Share of the image before, that blur and gamma do not imitate, and in its standard errors."""

LIGHT_SHARE = 0.008
"""Share of the residual, beyond that of as many values of noise, that one step of a term of the
light must explain for it to be estimated: measured, light that is corrected explains 0.014."""
NO_WORSE = 1.1
"""Factor of the least residual of all steps that the last one may leave: the pixels' weights change
from step to step."""
BETTER_LIGHT, EXPLAINED_WELL = (0.9, 0.75), 0.05
"""Share of the residual that one term of the light, and a second one, may leave; and the share that
a single term leaves where no second one is tried, nor the rows asked whether they show a wave."""
EXPLAINED_BY_LIGHT, EXPLAINED_CLEARLY = 0.78, 0.55
"""Share of the residual that light may leave where equal means do not confirm it, and where they
refute it, as those of few fringes in view do."""
AS_WELL = 1.02
"""Factor by which light may raise the misfit of pixels predicted from their neighbours: small gains
hardly change it, and those that imitate a strange frame do."""
LEAST_GAIN, LEAST_GAIN_OF_THREE, LEAST_CODED_GAIN = 0.0075, 0.01, (0.045, 0.25)
"""Variation of the gains below which they are not corrected: rms over the steps of a period, where
response and blur of a camera imitate as much; of three steps, which hardly determine it; and of
stripes, which blur imitates and thresholds tolerate: alone, and beside fringes, which would show
it."""
REPORTED = 0.03
"""Variation of the brightness, from the darkest to the brightest frame, that is reported."""
AGREED = 1.8
"""Standard errors, by the scatter of parts of the image, that gains must vary by."""
FARTHEST_GAIN = 0.7
"""Logarithm of a gain over the median of its kind beyond which a frame shows something else."""
LEAST_WAVE, LEAST_ROOM = 0.01, 0.03
"""Rms of a wave along the rows, and change of the room's light over the mean grey level, that are
corrected."""
LEFT_BY_DRIFT = 0.5
"""Part of the inequality of frames' sums that a drift leaves at most: blurred stripes of dim
captures are clipped more or less by their width, and imitate one in part."""
SEEN_OF_ROWS, SEEN_WAVE = {"phase": 0.7, "gray": 0.25}, (0.5, 2.0)
"""Share of the variation of the rows' means that a wave must explain, and their amplitude over the
wave's. Phase steps have equal means (flicker explains 0.93 and more); sums of a bit and its inverse
also vary with blur and clipping (flicker explains 0.46)."""
FEW_FRAMES_KNOWN = 3
"""Frames on either side of a change of the room's light: one or two may just be of other gain."""
REFUTED, REFUTED_LEAST = 1.5, 0.004
"""Factor, and share of the brightness, by which a correction may worsen the equality of means."""
DEEPEST = 0.75
"""Variation of means under the light that is corrected, over the depth of the patterns: a cosine
has 0.71."""
CONFIRMED, CONFIRMED_LEAST = 0.65, 0.01
"""Factor by which a correction improves it that is accepted although blur or the projector's
response leave residuals; and variation that is not a matter of too few fringes in view."""
MEAN_ROWS, MEAN_COLUMNS = 16, 4
"""Every so many rows and columns are averaged: enough for a thousandth."""
OUTLIER = 4.0
"""Squared residual of a pixel over the median, from which it loses weight."""
MOST_STEPS, CONVERGED = 10, 5e-4
"""Gauss-Newton steps of the light, and change of all its values that ends them."""
UNKNOWN_GAIN = 0.1
"""Standard error of a gain from which the mean of its group is used: dark stripes hardly depend on
it."""
SCATTERED = 0.03
"""Light that the scene scatters into dark stripes, of the contrast."""
FUZZY = 0.4
"""Share of the pixels at a stripe's edge, from which blur may have changed its contrast."""
FUZZY_WEIGHT = 0.2
"""Weight of their levels: blur changes them by up to a third of the contrast."""
FUZZY_LEVEL = 1.0
"""Uncertainty of the level of stripes whose every pixel is at an edge, of the contrast: a tone
curve makes light out of blur."""
CONTRAST_PRIORS = 0.1, 0.5
"""Uncertainty of the contrast of a frame's stripes: wide ones scatter light, and blur takes all of
it from fine ones."""
