"""Whether boards that are cut by the image's border, the light's edge or a hand are numbered right,
or refused with the reason; never wrongly."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from slviewer.errors import DetectionError
from slviewer.pipeline.operation import Progress
from slviewer.target.board import Board, Detection
from slviewer.target.detect import detect
from tests.proofs.proof import BandCheck, Proof, prove_checks

VIEWS = 2000
"""Cut views at full size."""
BOARDS = (
    *("circles:9x7:20", "circles:14x9:15", "circles:21x16:9", "acircles:4x9:20"),
    *("chessboard:9x6:20", "chessboard:8x6:20", "chessboard:7x7:20", "chessboard:13x9:12"),
)
CUTS = ("border", "two borders", "light", "hand", "bright hand", "bars")
SKIN = {"hand": (0.2, 0.85), "bright hand": (0.9, 1.05)}
"""Least and most that a hand reflects, of what paper does: a glove, or one nearer to the light."""
SIZE = 640, 480
"""Of the images, px."""
MOST_CUT = 0.5
"""Share of the board's extent in the image."""
OFF_PITCHES = 0.2
"""Distance from its true place beyond which a feature is numbered wrongly."""
LEAST_RIGHT = {
    "border": 0.7, "two borders": 0.4, "light": 0.7, "hand": 0.65,
    "bright hand": 0.55, "bars": 0.7,
}  # fmt: skip
"""Least share of views that are numbered for certain; of fewer views than at full size, within two
standard errors."""
FINE = 3
"""Samples per pixel, each way."""
PX_PER_PITCH = 48
"""Resolution of the drawn sheet."""


@dataclass(frozen=True, eq=False)
class CutView:
    """An image (h, w) uint8 of a board that is partly hidden by a ``cut``, and where its features
    are in it, ``truth`` (n, 2) px, also outside the image."""

    board: Board
    cut: str
    image: np.ndarray
    truth: np.ndarray

    def is_right(self, detection: Detection) -> bool:
        """Whether each feature is where the board has it, by one of the numberings in which the
        board looks the same."""
        steps = np.diff(self.truth.reshape(self.board.rows, self.board.columns, 2), axis=1)
        off = OFF_PITCHES * float(np.median(np.hypot(*steps.reshape(-1, 2).T)))
        if self.board.kind == "acircles":
            off /= 2
        return any(
            np.hypot(*(detection.pixels - self.truth[order][ids]).T).max() < off
            for ids in (detection.ids, *detection.others)
            for order in _alike(self.board)
        )


def _alike(board: Board) -> Iterator[np.ndarray]:
    """Yield the orders (n,) of the features in which the board, turned, looks the same."""
    original = board.nodes - (board.nodes.min(0) + board.nodes.max(0)) / 2
    turned = original
    for turn in range(4):
        apart = np.linalg.norm(turned[:, None] - original, axis=2)
        # a turn moves the first square to where the first, columns or columns + rows are
        moved = (0, board.columns, board.columns + board.rows, board.rows)[turn]
        is_same_colour = board.kind != "chessboard" or moved % 2 == 0
        if is_same_colour and apart.min(1).max() < 1e-6:
            yield apart.argmin(1)
        turned = turned @ [[0, 1], [-1, 0]]


def draw_views(count: int, seed: int) -> Iterator[CutView]:
    """Yield views of boards of all kinds in turn, tilted, blurred and noisy, each cut by up to
    half."""
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        board = Board.parse(BOARDS[number % len(BOARDS)])
        yield draw_view(board, CUTS[number // len(BOARDS) % len(CUTS)], rng)


def draw_view(board: Board, cut: str, rng: np.random.Generator) -> CutView:
    """Return a view of a board that is hidden in part."""
    sheet, to_sheet = _draw_sheet(board, rng)
    to_image = _draw_pose(board, rng)
    bend = rng.uniform(-0.15, 0.1)
    truth = _distort(_project(to_image, board.points[:, :2]), bend)
    low, high = truth.min(0), truth.max(0)
    shift = np.array(SIZE) / 2 - (low + high) / 2
    sides = rng.permutation(2)[: {"border": 1, "bars": 1, "two borders": 2}.get(cut, 0)]
    for k in sides:
        share = rng.uniform(0.05, MOST_CUT) * (1 if len(sides) == 1 else 0.8)
        reach = share * (high[k] - low[k])
        shift[k] = -low[k] - reach if rng.random() < 0.5 else SIZE[k] - high[k] + reach
    to_image = np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1]]) @ to_image
    truth = _distort(_project(to_image, board.points[:, :2]), bend)
    image = _look(sheet, to_sheet @ np.linalg.inv(to_image), bend, rng)
    if cut == "light":
        image = image * _draw_light(truth, rng)
    if cut in ("hand", "bright hand"):
        image = _cover_by_hand(image, truth, rng, *SKIN[cut])
    image = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
    image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.3))
    image = rng.uniform(110, 230) * image + rng.normal(0, rng.uniform(0.5, 3), image.shape)
    if cut == "bars":
        image, truth = _add_bars(image, truth, rng)
    return CutView(board, cut, np.clip(np.rint(image), 0, 255).astype(np.uint8), truth)


def _add_bars(
    image: np.ndarray, truth: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return the image and its features with bars of one level, black to white, at some sides, half
    of them with noise."""
    left, right, top, bottom = (rng.integers(8, 100, 4) * (rng.random(4) < 0.6)).tolist()
    level, noise = rng.choice([0, 16, 128, 255]), rng.choice([0.0, 1.5])
    size = image.shape[0] + top + bottom, image.shape[1] + left + right
    barred = level + rng.normal(0, noise, size)
    barred[top : top + image.shape[0], left : left + image.shape[1]] = image
    return barred, truth + np.array([left, top])


def _draw_sheet(board: Board, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the printed sheet as albedo (h, w) float32, and the map (3, 3) from mm to its
    pixels."""
    margin = rng.uniform(1.3, 2.2)
    scale = PX_PER_PITCH / board.pitch_mm
    low = board.points[:, :2].min(0) - margin * board.pitch_mm
    size = (np.ptp(board.points[:, :2], axis=0) + 2 * margin * board.pitch_mm) * scale
    width, height = np.rint(size).astype(int).tolist()
    ink = float(rng.uniform(0.04, 0.2))
    sheet = np.ones((height, width), np.float32)
    to_sheet = np.array([[scale, 0, -low[0] * scale], [0, scale, -low[1] * scale], [0, 0, 1]])
    centres = _project(to_sheet, board.points[:, :2])
    if board.kind == "chessboard":
        x0, y0 = centres[0] - PX_PER_PITCH
        for i in range(board.rows + 1):
            for j in range(board.columns + 1):
                if (i + j) % 2 == 0:
                    u, v = round(x0 + j * PX_PER_PITCH), round(y0 + i * PX_PER_PITCH)
                    sheet[v : v + PX_PER_PITCH, u : u + PX_PER_PITCH] = ink
    else:
        apart = 2**0.5 if board.kind == "acircles" else 1.0
        radius = round(rng.uniform(0.22, 0.3) * apart * PX_PER_PITCH * 16)
        for u, v in np.rint(centres * 16).astype(int).tolist():
            cv2.circle(sheet, (u, v), radius, ink, -1, cv2.LINE_AA, 4)
    return sheet, to_sheet


def _draw_pose(board: Board, rng: np.random.Generator) -> np.ndarray:
    """Return the homography (3, 3) from mm on the board to px, without the lens."""
    tilt, axis = np.deg2rad(rng.uniform(0, 40)), rng.uniform(0, 2 * np.pi)
    roll = np.deg2rad(rng.uniform(-180, 180) if rng.random() < 0.5 else rng.normal(0, 8))
    R = (
        cv2.Rodrigues(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))[0]
        @ cv2.Rodrigues(np.array([0.0, 0.0, roll]))[0]
    )
    extent = np.ptp(board.points[:, :2], axis=0)
    spread = np.abs(R[:2, :2]) @ extent
    focal = rng.uniform(1.1, 2.5) * SIZE[0]
    depth = focal * (spread / SIZE).max() / rng.uniform(0.6, 0.95)
    T = np.array([0.0, 0.0, depth]) - R @ np.array([*(extent / 2), 0.0])
    K = np.array([[focal, 0, SIZE[0] / 2], [0, focal, SIZE[1] / 2], [0, 0, 1]])
    return np.asarray(K @ np.c_[R[:, :2], T])


def _project(H: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Map points (n, 2) by a homography (3, 3)."""
    return np.asarray(cv2.perspectiveTransform(np.asarray(points, float)[None], H)[0])


def _straighten(pixels: np.ndarray, bend: float) -> np.ndarray:
    """Remove the lens's distortion ``bend`` (at half the width) from pixels (..., 2)."""
    offset = pixels - np.array(SIZE) / 2
    squared = (offset**2).sum(-1, keepdims=True) / (SIZE[0] / 2) ** 2
    return np.asarray(pixels + offset * bend * 0.3 * np.minimum(squared, 2.0))


def _distort(pixels: np.ndarray, bend: float) -> np.ndarray:
    """The inverse of ``_straighten``, for pixels (n, 2)."""
    bent = pixels.copy()
    for _ in range(30):
        bent -= _straighten(bent, bend) - pixels
    return bent


def _look(
    sheet: np.ndarray, to_sheet: np.ndarray, bend: float, rng: np.random.Generator
) -> np.ndarray:
    """Return the light (FINE h, FINE w) float32 that the camera sees: the sheet before a cloudy
    background, unevenly lit."""
    width, height = (FINE * n for n in SIZE)
    v, u = np.mgrid[:height, :width]
    pixels = (np.stack([u, v], axis=-1) + 0.5) / FINE - 0.5
    places = _project(to_sheet, _straighten(pixels, bend).reshape(-1, 2)).astype(np.float32)
    cloud = cv2.resize(rng.uniform(0.1, 0.7, (8, 10)).astype(np.float32), (width, height))
    x, y = places.reshape(height, width, 2).transpose(2, 0, 1)
    seen = cv2.remap(
        sheet, x, y, cv2.INTER_LINEAR,
        borderValue=-1,
    )  # fmt: skip
    corners = rng.uniform(0.55, 1.0, (2, 2)).astype(np.float32)
    return np.asarray(np.where(seen < 0, cloud, seen) * cv2.resize(corners, (width, height)))


def _draw_light(truth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the light (FINE h, FINE w) of a projector whose edge, along the image's sides or
    across, leaves a part of the board dark."""
    angle = rng.choice([0, 0.5, 1, 1.5]) * np.pi + rng.normal(0, 0.05 if rng.random() < 0.5 else 1)
    normal = np.array([np.cos(angle), np.sin(angle)])
    along = truth @ normal
    edge = along.max() - rng.uniform(0.05, MOST_CUT) * np.ptp(along)
    v, u = np.mgrid[: FINE * SIZE[1], : FINE * SIZE[0]] / FINE
    distance = u * normal[0] + v * normal[1] - edge
    dark, soft = rng.uniform(0, 0.08), rng.uniform(0.3, 4)
    return np.asarray(dark + (1 - dark) / (1 + np.exp(np.clip(distance / soft, -50, 50))))


def _cover_by_hand(
    image: np.ndarray, truth: np.ndarray, rng: np.random.Generator, dark: float, bright: float
) -> np.ndarray:
    """Return the image with a hand, four fingers on a palm, that comes from a side of the board and
    reflects ``dark`` to ``bright`` of what paper does."""
    angle = rng.uniform(0, 2 * np.pi)
    inwards = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-inwards[1], inwards[0]])
    along, beside = truth @ inwards, truth @ across
    tip = along.min() + rng.uniform(0.1, MOST_CUT) * np.ptp(along)
    middle = rng.uniform(*np.quantile(beside, [0.1, 0.9]))
    width = rng.uniform(0.08, 0.16) * np.ptp(beside)
    mask = np.zeros(image.shape, np.uint8)
    for finger in range(4):
        end = tip - rng.uniform(0, 0.1) * np.ptp(along)
        at = middle + (finger - 1.5) * 1.05 * width
        near = inwards * end + across * at
        far = inwards * (along.min() - np.ptp(along)) + across * (at + rng.normal(0, 0.3) * width)
        start, stop = np.rint(FINE * np.stack([near, far])).astype(int).tolist()
        cv2.line(mask, start, stop, 1, max(1, round(FINE * width)), cv2.LINE_AA)
    skin = rng.uniform(dark, bright) * (
        1 + 0.1 * cv2.resize(rng.normal(0, 1, (12, 16)), mask.shape[::-1])
    )
    shade = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), FINE * rng.uniform(1, 8))
    return np.asarray(np.where(mask > 0, skin * (0.6 + 0.4 * shade), image * (1 - 0.3 * shade)))


def judge_view(view: CutView) -> tuple[str, str]:
    """Return how a view is answered, with the reason where it is refused: ``right``, ``several``
    where a calibration is left to choose, ``refused`` or ``wrong``."""
    try:
        detection = detect(view.board, view.image, several=True)
    except DetectionError as error:
        return "refused", str(error)
    if not view.is_right(detection):
        return "wrong", ""
    return ("several" if len(detection.others) else "right"), ""


def prove_cut_boards(scale: float, seed: int, progress: Progress) -> Proof:
    """Detect the boards of cut views, and count how they are answered, by board and by what cuts
    them."""
    count = round(VIEWS * scale)
    answers = Counter[tuple[str, str, str]]()
    for number, view in enumerate(draw_views(count, seed)):
        progress(number / count, "detecting cut boards")
        answer, reason = judge_view(view)
        if answer == "refused" and ":" not in reason:
            answer = "wrong"
        answers[view.board.kind, view.cut, answer] += 1
    rows, checks = [], []
    kinds = list(dict.fromkeys(board.split(":")[0] for board in BOARDS))
    for kind in kinds:
        for cut in CUTS:
            n = {a: answers[kind, cut, a] for a in ("right", "several", "refused", "wrong")}
            rows.append({"board": kind, "cut by": cut, "views": sum(n.values()), **n})
            checks.append(BandCheck(f"{kind}, {cut}", "wrong numberings", n["wrong"], 0, 0))
    for cut, least in LEAST_RIGHT.items():
        of_cut = {key: n for key, n in answers.items() if key[1] == cut}
        views = sum(of_cut.values())
        share = sum(n for key, n in of_cut.items() if key[2] == "right") / views
        if scale < 1:  # what chance leaves of fewer views
            least -= 2 * float(np.sqrt(least * (1 - least) / views))
        checks.append(BandCheck(cut, "share numbered for certain", share, least, 1))
    return prove_checks(checks, scale, rows, {"views": rows}, [f"{count} cut views, seed {seed}"])
