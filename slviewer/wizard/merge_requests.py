"""What an operator can ask of merges: to make one, and to take it back."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar

from slviewer.errors import InputError
from slviewer.pipeline.merge import Picked, StartKind
from slviewer.registration.refusal import Refused
from slviewer.wizard import tasks
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.notices import words_for
from slviewer.wizard.requests import RequestHandler, request

MERGING = "Merging"
_ELSEWHERE = {
    "features": "Or begin by points that you pick.",
    "turntable": "Or begin by their shapes, or by points that you pick.",
    "identity": "Or begin by their shapes, or by points that you pick.",
    "picked": "Or pick other points.",
}
"""What else to try where scans do not come together from a start."""
T = TypeVar("T")


class MergeRequests(RequestHandler):
    """Merging scans by the worker; what could not be merged is told until the next try."""

    @request(MERGING)
    def merge(
        self,
        names: Sequence[str],
        reference: str,
        *,
        start: StartKind = "features",
        angle: float | None = None,
        picked: Picked | None = None,
    ) -> None:
        """Register scans, named in the order in which they were taken, to a reference, and merge them; `undo_merge`
        takes it back. Where registration starts, as `pipeline.merge` takes it.
        """
        engine = self._engine
        store, engine.not_merged = engine.store, ""
        chosen = [store.load_capture(name).name for name in names]
        merge = partial(
            tasks.merge_scans, store, chosen, reference, start=start, angle=angle, picked=picked, warn=self._warn
        )

        def failed(error: BaseException) -> None:
            words = words_for(MERGING, error)
            if isinstance(error, Refused) and error.reason in ("overlap", "disagree"):
                words = f"{words} {_ELSEWHERE['picked' if picked else start]}"
            engine.not_merged = words
            engine.notices.tell("error", engine.not_merged)

        self._submit(MERGING, merge, partial(tasks.told_merge, reference), failed)

    @request("Undoing the merge")
    def undo_merge(self) -> None:
        """Move the current merge to the trash; the one before it is current again."""
        view, store = self._engine.publisher.now().session, self._engine.store
        if view is None or view.merge is None:
            raise InputError("there is no merge to take back")
        store.trash_result(f"merge/{view.merge.name}")
        (store.exports / f"merged_{view.merge.name}.ply").unlink(missing_ok=True)

    @abstractmethod
    def _submit(
        self,
        name: str,
        make: Callable[[Reporter], T],
        sentence: Callable[[T], str],
        failed: Callable[[BaseException], None] | None = None,
    ) -> None: ...

    @abstractmethod
    def _warn(self, text: str) -> None: ...
