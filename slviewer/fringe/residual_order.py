"""Estimation of the step that each phase-shifted frame shows.

Every way in which frames can be out of order is tested as a hypothesis: it fits when its residual
is as small as the noise, and it is accepted when it explains as much residual as such a fault would
have caused. This needs only the frames' products with each other, (n, n) numbers.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from slviewer.fringe.ghost import detect_ghosting
from slviewer.fringe.residual_sample import Fringe, cosine_columns
from slviewer.fringe.sequence import Indices
from slviewer.fringe.suspect import Fault, Suspect

_AS_EXPECTED = 0.7
"""Residual that a hypothesis must explain, as a share of the residual that its fault would
cause."""
_STRANGE = 0.08
"""rms error, as a share of the modulation, from which a frame that no step explains is strange."""
_STRANGE_NOISE = 5.0  # its square must also exceed this many times the variance of the other frames
# hypotheses within this factor of the least noise, plus this share of the squared fringe, are
# equally good
_AS_GOOD = 1.3
_AS_GOOD_FRINGE = 3e-3
_SAME = 1e-6
# squared difference of repeated frames, as a share of the usual one between successive frames
_ALIKE = 0.1
_LIGHT_ALONE = (
    0.4  # share of the squared difference that remains after scaling, if only the light differs
)
_DARKEST = 0.6  # no lamp flickers by more
_MOST_FAULTS = 3
_FEWEST_ORDERED = (
    5  # of four steps and fewer every order is a turn, a reflection or an exchange of two
)
_OFF_STEP = 0.25  # tolerance of a frame's position, in steps, and of its radius
# share of the frames below which single frames have changed places, and the others are in order
_FEW_MISPLACED = 0.5


@dataclass(frozen=True)
class _Hypothesis:
    """Hypothesis of a fault: the step that each frame shows.

    ``steps``: step by position in the capture, 0 for this period's first frame. ``place``: position
    of the faulty frame; ``other``: position of the frame whose pattern it shows, or the number of
    images of lag.
    """

    fault: Fault
    steps: dict[int, int]
    place: int
    other: int = 0


def detect_misordered_steps(sampled: Fringe) -> list[Suspect]:
    """Return a suspect for each frame of a period that does not show its own step.

    Where two explanations are equally good, the sentence gives both.
    """
    n = sampled.steps
    products = _Products(sampled, sampled.frames)
    if repeated := _detect_repeated_steps(sampled, products):
        return [
            _report_fault([_Hypothesis("late", {}, k, k - 1)], sampled.shift.indices)
            for k in repeated
        ]
    if n == 3:
        return []
    products = _choose_products(sampled, products)
    accepted = _Hypothesis("strange", {k: k for k in range(n)}, 0)
    suspects: list[Suspect] = []
    for _ in range(_MOST_FAULTS):
        chosen = _choose_hypothesis(products, accepted, n)
        if chosen is None:
            break
        accepted = chosen[0]
        suspects.append(_report_fault(chosen, sampled.shift.indices))
    return suspects


def recover_step_order(sampled: Fringe) -> list[int] | None:
    """Return the step that each frame of a period shows, if all steps are present but not in the
    described order.

    None where the frames are in their described order, up to its first step and direction, or in no
    order.

    The frames less their mean span the plane of the vectors cos(2 pi k / n) and sin(2 pi k / n): in
    any orthonormal basis of this plane the position of a frame is its step, rotated or mirrored.
    """
    n = sampled.steps
    if n < _FEWEST_ORDERED:
        return None
    frames = sampled.seen - sampled.seen.mean(axis=0)
    basis = np.linalg.eigh((frames @ frames.T).astype(float))[1][:, -2:]
    turns = np.arctan2(basis[:, 1], basis[:, 0]) * n / (2 * np.pi)
    turns -= np.angle(np.mean(np.exp(2j * np.pi * turns))) / (2 * np.pi)  # whole steps apart
    places = np.rint(turns).astype(int) % n
    radius = np.hypot(*basis.T) / np.sqrt(2 / n)
    if (
        len(set(places.tolist())) < n
        or np.abs(turns - np.rint(turns)).max() > _OFF_STEP
        or np.ptp(radius) > _OFF_STEP
    ):
        return None
    described = np.arange(n)
    orders = [(sign * places + first) % n for sign in (1, -1) for first in range(n)]
    steps = min(orders, key=lambda order: np.count_nonzero(order != described))
    if np.count_nonzero(steps != described) < _FEW_MISPLACED * n:
        return None
    return [int(step) for step in min(orders, key=lambda order: (order[0], order[1]))]


def detect_foreign_frames(sampled: Fringe) -> list[Suspect]:
    """Return suspects for frames that contain a share of the image before them, or that no step
    explains."""
    return detect_ghosting(sampled) or detect_strange_frames(sampled)


def detect_strange_frames(sampled: Fringe) -> list[Suspect]:
    """Return suspects for frames that no step explains, after order, light and ghosting have been
    excluded."""
    n = sampled.steps
    products = _choose_products(sampled, _Products(sampled, sampled.frames))
    steps = {k: k for k in range(n)}
    out: list[Suspect] = []
    while len(out) < _MOST_FAULTS:
        residual, freedom = products.compute_residual(steps)
        without = {
            k: products.compute_residual({i: s for i, s in steps.items() if i != k}) for k in steps
        }
        k = min(without, key=lambda i: without[i][0])
        rest, more = without[k]
        if more < 1:
            break
        gain = residual - rest - (freedom - more) * rest / more
        least = max(_STRANGE**2 * products.strength, _STRANGE_NOISE * rest / more)
        if gain < least or _differs_in_light_only(sampled, k):
            break
        del steps[k]
        i = sampled.shift.indices[k]
        text = (
            f"frame {i + 1} does not fit the other steps: something else was shown, or something"
            " moved"
        )
        out.append(Suspect(i, "strange", text))
    return out


def _differs_in_light_only(sampled: Fringe, k: int) -> bool:
    """Return whether frame ``k`` is what the other frames predict, up to a factor of brightness."""
    n, others = sampled.steps, np.delete(np.arange(sampled.steps), k)
    weights = cosine_columns(np.array([k]), n, sampled.own) @ np.linalg.pinv(
        cosine_columns(others, n, sampled.own)
    )
    expected = np.einsum("k,kp->p", weights[0].astype(np.float32), sampled.frames[others])
    frame = sampled.frames[k]
    scale = float(frame @ expected) / max(float(expected @ expected), 1e-9)
    if not _DARKEST < scale < 1 / _DARKEST:
        return False
    return float(np.mean((frame - scale * expected) ** 2)) < _LIGHT_ALONE * float(
        np.mean((frame - expected) ** 2)
    )


class _Products:
    """Mean products of the frames of a period, and of those around them, over the sampled pixels.

    ``places``: positions of these frames, 0 for the period's first; ``strength``: mean square of
    the modulation, halved.
    """

    def __init__(self, sampled: Fringe, frames: np.ndarray) -> None:
        """Compute the products of ``frames`` (n, p) and of the frames shown right before and after
        them."""
        first = sampled.shift.indices[0]
        mean = frames.mean(axis=0)  # the fitted background absorbs it, and numbers become smaller
        rows = dict(enumerate(frames))
        rows |= {i - first: frame for i, frame in sampled.beside.items()}
        self.places = sorted(rows)
        data = np.stack([rows[place] - mean for place in self.places])
        self._products = (data @ data.T).astype(float) / data.shape[1]
        self._index = {place: i for i, place in enumerate(self.places)}
        self._n, self._own = sampled.steps, sampled.own
        # The fringe at step angle d is its real part times cos d, less its imaginary part times sin
        # d.
        parts = np.stack([sampled.phasor.real, -sampled.phasor.imag])
        self._fringe = (parts @ parts.T).astype(float) / parts.shape[1]
        self.strength = float(np.trace(self._fringe)) / 2

    def compute_residual(self, steps: dict[int, int]) -> tuple[float, int]:
        """Return the residual of a hypothesis, squared grey levels per pixel, and its degrees of
        freedom.

        ``steps``: the step that the frame at each position shows.
        """
        rows = np.array([self._index[place] for place in steps])
        projection, freedom = _compute_residual_projector(tuple(steps.values()), self._n, self._own)
        return float((projection * self._products[rows[:, None], rows]).sum()), freedom

    def judge(self, accepted: dict[int, int], n: int) -> list[tuple[_Hypothesis, float, int]]:
        """Return each further hypothesis besides ``accepted`` of n steps that can fail, with its
        `compute_residual`."""
        hypotheses = _list_hypotheses(accepted, self.places, n)
        judged = [
            (hypothesis, *self.compute_residual(hypothesis.steps)) for hypothesis in hypotheses
        ]
        return [each for each in judged if each[2] >= 1]

    def predict_residual(self, before: dict[int, int], after: dict[int, int]) -> float:
        """Return the residual that the fringe alone has under ``before`` if ``after`` is true, in
        squared grey levels.

        Both are steps by position; only positions in both count.
        """
        shared = [place for place in before if place in after]
        projection, _ = _compute_residual_projector(
            tuple(before[place] for place in shared), self._n, self._own
        )
        fringe = cosine_columns(np.array([after[place] for place in shared]), self._n, 1)[:, 1:]
        return float(np.sum(projection * (fringe @ self._fringe @ fringe.T)))

    def predict_least_residual(self, steps: dict[int, int], n: int) -> float:
        """Return the residual that the smallest fault causes, one late frame, in squared grey
        levels."""
        return min(self.predict_residual(steps, steps | {k: k - 1}) for k in range(1, n))


@lru_cache(4096)
def _compute_residual_projector(steps: Indices, n: int, own: int) -> tuple[np.ndarray, int]:
    """Return the (k, k) matrix that projects frames of these k steps onto their residual, and its
    degrees of freedom.

    ``n``: steps of the period; ``own``: number of harmonics fitted per pixel.
    """
    basis, sizes, _ = np.linalg.svd(cosine_columns(np.array(steps), n, own), full_matrices=False)
    basis = basis[:, sizes > 1e-6 * sizes[0]]
    return np.eye(len(steps)) - basis @ basis.T, len(steps) - basis.shape[1]


def _choose_products(sampled: Fringe, products: _Products) -> _Products:
    """Return the products to judge by: those of the corrected frames, or of the frames as captured.

    A frame far out of order distorts the harmonics that are attributed to gamma.
    """
    nominal = {k: k for k in range(sampled.steps)}
    if products.compute_residual(nominal)[0] < _AS_EXPECTED * products.predict_least_residual(
        nominal, sampled.steps
    ):
        return products
    raw = _Products(sampled, sampled.seen)

    def compute_lowest_residual(products: _Products) -> float:
        """Return the smallest residual, per degree of freedom, of any hypothesis."""
        return min(
            (rest / more for _, rest, more in products.judge(nominal, sampled.steps)),
            default=np.inf,
        )

    return min((products, raw), key=compute_lowest_residual)


def _choose_hypothesis(
    products: _Products, accepted: _Hypothesis, n: int
) -> list[_Hypothesis] | None:
    """Return the hypothesis to accept instead of ``accepted``, with those that are as good; None if
    there is none."""
    residual, freedom = products.compute_residual(accepted.steps)
    least = products.predict_least_residual(accepted.steps, n)
    if residual < _AS_EXPECTED * least:
        return None
    judged = products.judge(accepted.steps, n)
    if not judged:
        return None
    noise = min(rest / more for _, rest, more in judged)
    limit = _AS_GOOD * noise + _AS_GOOD_FRINGE * products.strength
    fitting = [each for each in judged if each[1] / each[2] <= limit]
    # The hypothesis that explains the most frames is the most easily refuted, hence the one to
    # accept.
    fine = _SAME * products.strength
    hypothesis, rest, more = min(
        fitting, key=lambda each: (-each[2], round(each[1] / fine), _rank_hypothesis(each[0]))
    )
    gain = (residual - freedom * noise) - (rest - more * noise)
    caused = products.predict_residual(accepted.steps, hypothesis.steps)
    if caused > least / 2:
        believed = gain > _AS_EXPECTED * caused
    else:  # all steps are shifted alike, and only the excluded frames differ
        believed = gain > max(_STRANGE**2 * products.strength, _STRANGE_NOISE * noise)
    if hypothesis.fault == "strange" or not believed:
        return None
    swaps = [
        s for s, r, m in fitting if s.fault == "swapped" and m == more and abs(r - rest) <= fine
    ]
    return swaps if hypothesis.fault == "swapped" else [hypothesis]


def _rank_hypothesis(hypothesis: _Hypothesis) -> int:
    """Return the rank of a hypothesis by how frequent its fault is, 0 for the most frequent."""
    is_neighbour = abs(hypothesis.place - hypothesis.other) == 1
    if hypothesis.fault in ("late", "early"):
        return (0 if hypothesis.fault == "late" else 4) if is_neighbour else 5
    return {"swapped": 1, "dropped": 2, "lag": 3}.get(hypothesis.fault, 6)


def _list_hypotheses(accepted: dict[int, int], places: list[int], n: int) -> Iterator[_Hypothesis]:
    """Yield all hypotheses of a further fault besides those in ``accepted``, the simplest first.

    ``places``: positions of the frames whose products are known; ``n``: number of steps.
    """
    for k in range(n):
        for j in (k - 1, k + 1, *range(n)):
            if 0 <= j < n and j != accepted.get(k):
                yield _Hypothesis("late" if j < k else "early", accepted | {k: j}, k, j)
    for k in accepted:
        yield _Hypothesis("strange", {i: s for i, s in accepted.items() if i != k}, k)
    for k in range(n - 1):
        if accepted.get(k) == k and accepted.get(k + 1) == k + 1:
            yield _Hypothesis("swapped", accepted | {k: k + 1, k + 1: k}, k, k + 1)
    if all(accepted.get(k) == k for k in range(n)):
        yield from _list_shifted_frames(places, n)


def _list_shifted_frames(places: list[int], n: int) -> Iterator[_Hypothesis]:
    """Yield the hypotheses of a fault that shifts all frames after it."""
    for k in range(1, n - 1):
        yield _Hypothesis("dropped", {j: j if j < k else j + 1 for j in range(n - 1)}, k)
    after = [place for place in places if place >= n]
    if after:
        for k in range(1, n):
            late = {j: j if j < k else j - 1 for j in range(n)}
            yield _Hypothesis("lag", late | {n: n - 1}, k, 1)
        for shift in (1, 2):
            known = {j: j - shift for j in (*range(shift, n), *after) if 0 <= j - shift < n}
            yield _Hypothesis("lag", known, 0, shift)
    if -1 in places:
        yield _Hypothesis("dropped", {j: j + 1 for j in range(-1, n - 1)}, 0)


def _report_fault(hypotheses: list[_Hypothesis], indices: Indices) -> Suspect:
    """Return the suspect for hypotheses that explain the frames equally well."""
    texts = list(
        dict.fromkeys(_describe_hypothesis(hypothesis, indices) for hypothesis in hypotheses)
    )
    return Suspect(indices[hypotheses[0].place], hypotheses[0].fault, ", or ".join(texts))


def _describe_hypothesis(hypothesis: _Hypothesis, indices: Indices) -> str:
    """Return the sentence that reports a hypothesis to the operator; frames are counted from 1."""
    frame = indices[hypothesis.place] + 1
    other = indices[hypothesis.other] + 1 if hypothesis.other < len(indices) else frame
    images = "one image" if hypothesis.other == 1 else f"{hypothesis.other} images"
    texts: dict[Fault, str] = {
        "late": f"frame {frame} shows the pattern of frame {other}: it is late or repeated",
        "early": f"frame {frame} shows the pattern of frame {other}: it came too early",
        "swapped": f"frames {frame} and {other} have changed places",
        "dropped": f"frame {frame} is missing, and those that follow came too early",
        "lag": f"from frame {frame} on the camera is {images} behind the projector",
    }
    return texts[hypothesis.fault]


def _detect_repeated_steps(sampled: Fringe, products: _Products) -> list[int]:
    """Return the steps whose frame repeats the frame before it, judged by the usual difference of
    successive frames."""
    n, seen = sampled.steps, sampled.seen
    # two steps look alike where the pixels cover one side of the fringe only
    if n == 3 and not sampled.turns:
        return []
    differences = np.array([float(np.mean((seen[k] - seen[k - 1]) ** 2)) for k in range(1, n)])
    noise = 2 * sampled.roughness**2
    usual = float(np.max(differences) if n == 3 else np.median(differences))
    if noise > 0.5 * usual:
        return []
    alike = [k for k in range(1, n) if differences[k - 1] < _ALIKE * usual + 1.5 * noise]
    if n == 3 or len(alike) > _MOST_FAULTS:
        return alike[:1] if n == 3 else []
    nominal = {k: k for k in range(n)}
    residual, _ = products.compute_residual(nominal)
    rest, _ = products.compute_residual({k: k for k in range(n) if k not in alike})
    return (
        alike
        if rest < residual / 2 and residual > products.predict_least_residual(nominal, n) / 3
        else []
    )
