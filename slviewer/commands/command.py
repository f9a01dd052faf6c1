"""Makes a command of the terminal from the signature and the docstring of a function of the
program.

Both are read from the function's source, so that arguments are parsed and `--help` is shown before
anything heavy, such as NumPy, is imported. The parameters that `Args:` of the docstring describes
are the command's arguments; the others, and the text behind `Args:`, are for Python alone.
"""

import ast
import inspect
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import GenericAlias, MappingProxyType
from typing import Annotated, Any, Literal, Protocol, Union, get_args, runtime_checkable

import tyro

from slviewer import terminal
from slviewer.errors import SlviewerError, UsageError

ModelName = Literal["stereo", "pixelwise", "splined"]


@runtime_checkable
class Operational(Protocol):
    """An operation of `slviewer.pipeline.operation`, which is not imported here: it brings
    NumPy."""

    settings: Callable[..., Any]

    def run(self, session: Any, settings: Any, progress: Any, warn: Any) -> Any:
        """Run the operation on a session."""


Run = Callable[[Callable[..., Any], dict[str, Any]], None]
TYPES: dict[str, Any] = {"SessionLike": Path, "ModelName": ModelName, "Size": str}
"""What the terminal takes for types that are wider in Python; all others are looked up in the
function's module."""


@dataclass(frozen=True)
class Option:
    """An argument of a command that its function does not have."""

    name: str
    type: Any
    default: Any
    help: str


LARGEST = 1e12
"""The largest number, of any unit, that a command takes."""
RANGES: dict[str, tuple[float, float]] = {
    "at": (0, LARGEST),
    "budget_s": (0, LARGEST),
    "degree": (0, 10),
    "exposure_ms": (1e-6, 1e6),
    "exposures_ms": (1e-6, 1e6),
    "fill_holes": (0, 1e5),
    "folds": (2, 1000),
    "gain": (0, 1e4),
    "port": (0, 65535),
    "poses": (0, 1000),
    "seed": (0, (1 << 32) - 1),
    "smooth": (0, 1000),
    "triangles": (1, 1e9),
    "wait_s": (1, LARGEST),
}
"""Of the numbers that a command takes, by its parameter, where they are narrower."""
SETTINGS_OF = {"operation": 2, "takes_settings": 0}
"""Which argument of a decorator names the settings of the function."""
JSON = (Option("json", Path | None, None, "Write the result to this file too."),)


def read_command(
    source: str,
    *positional: str,
    options: Sequence[Option] = (),
    names: Mapping[str, str] = MappingProxyType({}),
    defaults: Mapping[str, Any] = MappingProxyType({}),
    description: str = "",
    run: Run | None = None,
) -> Callable[..., Callable[[], None]]:
    """Return the command of the function ``module:function`` of slviewer, or of a module in use,
    for tyro.

    The command's value is the work to do once all arguments are parsed.

    ``positional``: the parameters that are given without a name, ``options``: arguments that the
    function does not have, ``names``: {parameter: option} where these differ, ``defaults`` and
    ``description``: in place of the function's own, ``run``: what to do with the function and its
    arguments, by default `show_result`.
    """
    module, _, name = source.partition(":")
    module = module if module in sys.modules else f"slviewer.{module}"
    definition = _read_definitions(module)[name]
    assert isinstance(definition, ast.FunctionDef)
    doc, accepted = _read_arguments(definition, module)
    if "\nArgs:\n" not in doc:
        doc = doc.partition("\n\n")[0]
    shown = re.findall(r"^ {4}(\w+):", doc, re.MULTILINE)
    parameters = []
    for argument, default, place in accepted:
        if argument.arg not in shown:
            continue
        assert argument.annotation is not None
        kind = _terminal_type(_evaluate(argument.annotation, place))
        if defaults.get(argument.arg, ...) is None:
            kind = kind | None
        if argument.arg in positional:
            kind = Annotated[kind, tyro.conf.Positional]
        if argument.arg in names:
            kind = Annotated[kind, tyro.conf.arg(name=names[argument.arg])]
        value = inspect.Parameter.empty if default is None else _evaluate(default, place)
        value = defaults.get(argument.arg, value)
        parameters.append(_make_parameter(argument.arg, kind, value))
    for each in options:
        kind = Annotated[each.type, tyro.conf.arg(help=each.help)]
        parameters.append(_make_parameter(each.name, kind, each.default))

    def parse(**arguments: Any) -> Callable[[], None]:
        """Return the work to do: the function, imported only when it is called, with the parsed
        arguments."""

        def work() -> None:
            """Check the numbers among the arguments, and run the function."""
            _check_numbers(
                {names.get(option, option): value for option, value in arguments.items()}
            )
            (run or show_result)(getattr(import_module(module), name), arguments)

        return work

    parse.__doc__ = join_lines(description + doc[doc.index("\n\n") :] if description else doc)
    parse.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    parse.__annotations__ = {each.name: each.annotation for each in parameters}
    return parse


def join_lines(doc: str) -> str:
    """Return a docstring with each argument on one line: tyro would break the help where the source
    is broken."""
    return re.sub(r"\n {8,}(?=\S)", " ", doc)


def show_result(
    function: Callable[..., Any],
    arguments: dict[str, Any],
    describe: Callable[..., str] | None = None,
) -> None:
    """Call the function, write what it returns as JSON where that is requested, and print it.

    ``describe``: the text to print, from the result and the arguments; by default the result's own
    ``text()``. Raises SlviewerError with the result's ``failure``, where it has one.
    """
    json_file = arguments.pop("json", None)
    result = call(function, **arguments)
    write_json(json_file, result.to_json() if hasattr(result, "to_json") else result)
    if describe is not None:
        text = describe(result, **arguments)
    else:
        text = result if isinstance(result, str) else result.text()
    terminal.print_result(text)
    if failure := getattr(result, "failure", ""):
        raise SlviewerError(failure)


def call(function: Callable[..., Any], **arguments: Any) -> Any:
    """Call the function and return its result; its progress and warnings go to standard error."""
    if isinstance(function, Operational):
        session = arguments.pop("session")
        return function.run(
            session, function.settings(**arguments), terminal.progress, terminal.warn
        )
    callbacks = {"progress": terminal.progress, "warn": terminal.warn}
    callbacks = {
        name: callbacks[name]
        for name in callbacks
        if name in inspect.signature(function).parameters
    }
    return function(**arguments, **callbacks)


def write_json(path: Path | None, result: object) -> None:
    """Write a result, plain values or dataclasses, to the file of ``--json``; nothing without
    one."""
    if path is not None:
        from slviewer.records.plain import to_plain  # lazily: it brings NumPy

        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(result, indent=2, default=to_plain) + "\n")


def union(commands: Mapping[str, Callable[..., Any]]) -> Any:
    """Return the type whose value is one of the commands, for tyro."""
    choices = [
        Annotated[Any, tyro.conf.subcommand(name=name, constructor=f)]
        for name, f in commands.items()
    ]
    return Union[tuple(choices)]  # noqa: UP007 (built at run time)


def _check_numbers(arguments: Mapping[str, Any]) -> None:
    """Raise UsageError for numbers outside of their range in `RANGES`, and for any that is infinite
    or not a number."""
    for name, value in arguments.items():
        low, high = RANGES.get(name, (-LARGEST, LARGEST))
        for number in value if isinstance(value, tuple | list) else (value,):
            if isinstance(number, float | int) and not low <= number <= high:
                stated = f"{number:g}" if abs(number) < LARGEST else str(number)[:20]
                raise UsageError(
                    f"--{name.replace('_', '-')} is {stated}: give a number from {low:g} to"
                    f" {high:g}"
                )


def _make_parameter(name: str, kind: Any, default: Any) -> inspect.Parameter:
    """Return a keyword parameter of a command's signature."""
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=kind, default=default)


Argument = tuple[ast.arg, ast.expr | None, str]
"""A parameter, its default, None where it has none, and the module in which both are evaluated."""


def _read_arguments(definition: ast.FunctionDef, module: str) -> tuple[str, list[Argument]]:
    """Return the docstring of a function and its parameters; where it has settings, both are those
    of the settings."""
    doc = ast.get_docstring(definition) or ""
    for decorator in definition.decorator_list:
        made_by = (
            decorator.func.id
            if isinstance(decorator, ast.Call) and isinstance(decorator.func, ast.Name)
            else ""
        )
        if made_by in SETTINGS_OF:
            assert isinstance(decorator, ast.Call)
            name = decorator.args[SETTINGS_OF[made_by]]
            assert isinstance(name, ast.Name)
            described, fields = _read_settings(name.id, module)
            if made_by == "operation":
                described = f"    session: Session folder.\n{described}"
                fields.insert(0, (ast.arg("session", ast.Name("SessionLike")), None, module))
            return f"{doc}\n\nArgs:\n{described}", fields
    return doc, [(*argument, module) for argument in _list_arguments(definition)]


def _read_settings(name: str, module: str) -> tuple[str, list[Argument]]:
    """Return what a dataclass of settings and its bases describe of their fields, and these
    fields."""
    settings = _read_definitions(module)[name]
    if isinstance(settings, ast.ImportFrom):
        assert settings.module is not None
        return _read_settings(name, settings.module)
    assert isinstance(settings, ast.ClassDef)
    described, _, rest = (
        (ast.get_docstring(settings) or "").partition("Args:\n")[2].partition("\n\n")
    )
    nodes = [node for node in settings.body if isinstance(node, ast.AnnAssign)]
    fields = [
        (ast.arg(ast.unparse(node.target), node.annotation), node.value, module) for node in nodes
    ]
    for base in settings.bases:
        inherited, further = _read_settings(ast.unparse(base), module)
        described = "\n".join(filter(None, (described, inherited.partition("\n\n")[0])))
        fields += further
    return f"{described}\n\n{rest}", fields


def _list_arguments(definition: ast.FunctionDef) -> list[tuple[ast.arg, ast.expr | None]]:
    """List every parameter of a function with its default, None where it has none."""
    places, defaults = definition.args.args, definition.args.defaults
    required = [None] * (len(places) - len(defaults))
    keywords = zip(definition.args.kwonlyargs, definition.args.kw_defaults, strict=True)
    return [*zip(places, [*required, *defaults], strict=True), *keywords]


@cache
def _read_definitions(module: str) -> dict[str, ast.stmt]:
    """Return {name: node that defines or imports it} of a module's functions, types, constants and
    imports."""
    spec = find_spec(module)
    assert spec is not None and spec.origin is not None
    definitions: dict[str, ast.stmt] = {}
    for node in ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            definitions[node.name] = node
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            target = node.targets[0] if isinstance(node, ast.Assign) else node.target
            if isinstance(target, ast.Name):
                definitions[target.id] = node
        elif isinstance(node, ast.ImportFrom):
            definitions |= {alias.asname or alias.name: node for alias in node.names}
    return definitions


class _Names(dict[str, Any]):
    """Mapping of a module's names to their types and constants; those of slviewer are read from
    their source."""

    def __init__(self, module: str) -> None:
        super().__init__(TYPES)
        self._module = module

    def __missing__(self, name: str) -> Any:
        """Evaluate a name from the module's source, or import it. Raises KeyError."""
        node = _read_definitions(self._module).get(name)
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            return _evaluate(node.value, self._module)
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            inside = node.module.startswith("slviewer.")
            return (
                _Names(node.module)[name] if inside else getattr(import_module(node.module), name)
            )
        raise KeyError(name)


def _evaluate(expression: ast.expr, module: str) -> Any:
    """Evaluate an annotation or a default of a module, without importing the module."""
    return eval(ast.unparse(expression), {}, _Names(module))  # noqa: S307, our own source


def _terminal_type(kind: Any) -> Any:
    """Return the type for the terminal: `str | Path` becomes the first of both, sequences become
    tuples."""
    choices = get_args(kind)
    if Path in choices and str in choices:
        first = next(choice for choice in choices if choice in (Path, str))
        return first | None if type(None) in choices else first
    if getattr(kind, "__origin__", None) is Sequence:
        return GenericAlias(tuple, (_terminal_type(choices[0]), ...))
    return kind
