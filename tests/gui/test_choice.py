"""A dropdown that follows what is new, but never against its user."""

from contextlib import suppress
from types import SimpleNamespace
from typing import Any

from slviewer.gui.panel import Choice


class Dropdown:
    """Stands in for viser's: a value that a user chooses calls back as viser does."""

    options: tuple[str, ...] = ()
    value = ""

    def on_update(self, keep: Any) -> None:
        self._keep = keep

    def choose(self, text: str) -> None:
        self.value = text
        with suppress(StopIteration):  # it waits for nothing
            self._keep(SimpleNamespace(client_id=1)).send(None)


def test_new_values_become_the_choice_until_a_user_chooses() -> None:
    there, dropdown = ["a"], Dropdown()
    choice = Choice(dropdown, {}, lambda: there)
    offered = {"A": "a", "B": "b", "C": "c"}
    choice.offer(offered, "a")
    assert choice.value == "a"
    there.append("b")
    choice.offer(offered)
    assert choice.value == "b"
    there.append("c")  # it is there, but not drawn yet
    dropdown.choose("A")
    choice.offer(offered)
    assert choice.value == "a"


def test_a_drawing_of_older_values_takes_no_choice_back() -> None:
    there, dropdown = ["a", "b"], Dropdown()
    choice = Choice(dropdown, {}, lambda: there)
    choice.offer({"A": "a", "B": "b"}, "b")
    there.append("c")
    dropdown.choose("A")
    choice.offer({"A": "a", "B": "b"})  # what was drawn when the user chose
    choice.offer({"C": "c", "A": "a", "B": "b"})
    assert choice.value == "a"


def test_what_comes_back_is_new() -> None:
    there, dropdown = ["a", "b"], Dropdown()
    choice = Choice(dropdown, {}, lambda: there)
    choice.offer({"A": "a", "B": "b"}, "a")
    there.remove("b")
    choice.offer({"A": "a"})
    there.append("b")
    choice.offer({"A": "a", "B": "b"})
    assert choice.value == "b"
