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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, fields, is_dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import GenericAlias, MappingProxyType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import tyro

from slviewer import terminal
from slviewer.errors import SlviewerError
from slviewer.inputs import LARGEST, Input, find_input

ModelName = Literal["stereo", "pixelwise", "splined"]


T = TypeVar("T")
Function = Callable[..., Any]
Arguments = dict[str, Any]
"""Of a command, by name."""
Work = Callable[[], None]
Command = Callable[..., Work]
"""Called with the arguments; what it returns does the work."""
Run = Callable[[Function, Arguments], None]
TYPES: dict[str, Any] = {
    "SessionLike": Path,
    "ModelName": ModelName,
    "Size": str,
    "Input": Input,
}
"""What the terminal takes for types that are wider in Python; all others are looked up in the
function's module."""
JSON = ("commands.command:JsonFile",)
PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True)
class JsonFile:
    """Where the result goes too.

    Args:
        json: Write the result to this file too.
    """

    json: Path | None = None


def read_command(
    source: str,
    *positional: str,
    options: Sequence[str] = (),
    names: Mapping[str, str] = MappingProxyType({}),
    optional: Sequence[str] = (),
    description: str = "",
    run: Run | None = None,
) -> Command:
    """Return the command of the function ``module:function`` of slviewer, or of another package,
    for tyro.

    The command's value is the work to do once all arguments are parsed.

    ``positional``: the parameters that are given without a name, beside a session without default,
    ``options``: dataclasses, ``module:class``, whose fields are arguments too, ``names``:
    {parameter: option} where these differ, ``optional``: parameters that are None by default here,
    ``description``: in place of the function's own, ``run``: what to do with the function and its
    arguments, by default `show_result`.
    """
    module, name = _find_module(source)
    text, own = _read_function(module, name)
    parts = [own, *(_read_settings(*_find_module(each)) for each in options)]
    described = "\n".join(each for each, _ in parts)
    parameters, declared = [], dict[str, Input]()
    for argument, default, place in _list_described(parts):
        assert argument.annotation is not None
        annotation = place.evaluate(argument.annotation)
        declared[argument.arg] = find_input(annotation) or Input()
        kind = _terminal_type(annotation)
        value = inspect.Parameter.empty if default is None else place.evaluate(default)
        if argument.arg in optional:
            kind, value = kind | None, None
        if argument.arg in positional or (argument.arg == "session" and default is None):
            kind = Annotated[kind, tyro.conf.Positional]
        if argument.arg in names:
            kind = Annotated[kind, tyro.conf.arg(name=names[argument.arg])]
        keyword = inspect.Parameter.KEYWORD_ONLY
        parameters.append(inspect.Parameter(argument.arg, keyword, annotation=kind, default=value))

    def parse(**arguments: Any) -> Work:
        """Return the work to do: the function, imported only when it is called, with the parsed
        arguments."""

        def work() -> None:
            """Check the numbers among the arguments, and run the function."""
            _check_numbers(arguments, declared, names)
            (run or show_result)(getattr(import_module(module.name), name), arguments)

        return work

    # each argument on one line: tyro would break the help where the source is broken
    joined = _add_ranges(re.sub(r"\n {8,}(?=\S)", " ", described), declared)
    parse.__doc__ = (description or text) + (joined and f"\n\nArgs:\n{joined}")
    parse.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    parse.__annotations__ = {each.name: each.annotation for each in parameters}
    return parse


def read_operation(source: str) -> Command:
    """Return the command of an operation ``module:function``. What has no default is positional, up
    to the first of several values."""
    module, name = _find_module(source)
    _, (_, accepted) = _read_function(module, name)
    positional = []
    for argument, default, place in accepted:
        assert argument.annotation is not None
        kind = place.evaluate(argument.annotation)
        if default is not None or kind is KW_ONLY:
            break
        positional.append(argument.arg)
        if getattr(kind, "__origin__", None) is Sequence:
            break
    return read_command(source, *positional, options=JSON)


def take_options(arguments: Arguments, kind: type[T]) -> T:
    """Take the options out of a command's arguments that are the fields of a dataclass."""
    assert is_dataclass(kind)
    return kind(**{each.name: arguments.pop(each.name) for each in fields(kind)})


def show_result(function: Function, arguments: Arguments) -> None:
    """Call the function, write what it returns as JSON where that is requested, and print it: text,
    or the result's ``text()``.

    Raises SlviewerError with the result's ``failure``, where it has one.
    """
    json_file = arguments.pop("json", None)
    result = call(function, **arguments)
    write_json(json_file, result.to_json() if hasattr(result, "to_json") else result)
    terminal.print_result(result if isinstance(result, str) else result.text())
    if failure := getattr(result, "failure", ""):
        raise SlviewerError(failure)


def call(function: Any, **arguments: Any) -> Any:
    """Call the function and return its result; its progress and warnings go to standard error."""
    # an Operation, which is not imported here: it brings NumPy
    if hasattr(function, "settings"):
        session = arguments.pop("session")
        settings = function.settings(**arguments)
        return function.run(session, settings, terminal.progress, terminal.warn)
    callbacks = {"progress": terminal.progress, "warn": terminal.warn}
    accepted = inspect.signature(function).parameters
    return function(
        **arguments, **{name: each for name, each in callbacks.items() if name in accepted}
    )


def write_json(path: Path | None, result: object) -> None:
    """Write a result, plain values or dataclasses, to the file of ``--json``; nothing without
    one."""
    if path is not None:
        from slviewer.records.record import to_plain  # lazily: it brings NumPy

        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(result, indent=2, default=to_plain) + "\n")


def union(commands: Mapping[str, Function]) -> Any:
    """Return the type whose value is one of the commands, for tyro."""
    choices = [
        Annotated[Any, tyro.conf.subcommand(name=name, constructor=f)]
        for name, f in commands.items()
    ]
    return Union[tuple(choices)]  # noqa: UP007 (built at run time)


def _list_described(parts: Sequence["Described"]) -> list["Argument"]:
    """Return the arguments that are described: the others are for Python alone."""
    return [
        argument
        for text, arguments in parts
        for argument in arguments
        if re.search(rf"^ {{4}}{argument[0].arg}:", text, re.MULTILINE)
    ]


def _add_ranges(described: str, declared: Mapping[str, Input]) -> str:
    """Add to descriptions of arguments, one a line, what each may be, where that is limited."""
    for name, limits in declared.items():
        if limits.high < LARGEST:
            described = re.sub(
                rf"^( {{4}}{name}: .*)", rf"\1 ({limits.range})", described, flags=re.M
            )
    return described


def _check_numbers(
    arguments: Arguments, declared: Mapping[str, Input], names: Mapping[str, str]
) -> None:
    """Raise UsageError for a number among the arguments that is not what was declared, under the
    name of its option."""
    for name, value in arguments.items():
        declared[name].check(f"--{names.get(name, name).replace('_', '-')}", value)


Argument = tuple[ast.arg, ast.expr | None, "_Module"]
"""A parameter, its default, None where it has none, and the module in which both are evaluated."""
Described = tuple[str, list[Argument]]
"""What a docstring says of parameters below ``Args:``, and these."""


def _find_module(source: str) -> tuple["_Module", str]:
    """Return module and name of ``module:name``, of slviewer's where it has that one."""
    module, _, name = source.partition(":")
    own = PACKAGE / f"{module.replace('.', '/')}.py"
    return _read_module(f"{PACKAGE.name}.{module}" if own.exists() else module), name


_STATEMENT = re.compile(
    r"^(?:(@)|(?:def|class) (\w+)|(from [\w.]+ import )|([A-Za-z_]\w*)(?=: | = ))", re.MULTILINE
)
"""Beginning of a statement of a module: a decorator, a definition, an import or a value."""


class _Module(dict[str, Any]):
    """Types and constants of a module by name. Those of slviewer are evaluated from their source,
    statement by statement where they are used; the module is not imported."""

    def __init__(self, name: str) -> None:
        super().__init__(TYPES)
        self.name = name
        spec = find_spec(name)
        assert spec is not None and spec.origin is not None
        self._source = Path(spec.origin).read_text(encoding="utf-8")
        self._nodes: dict[str, ast.AST | None] = {}
        self._statements: dict[str, str] = {}
        try:
            self._split_source()
        except SyntaxError:  # a string of several lines looks like a statement
            self._parse(self._source)

    def _split_source(self) -> None:
        """Parse the imports, and note the text of the other statements by the names they define."""
        behind_docstring = self._source.find('"""', 3) + 3
        begun = [*_STATEMENT.finditer(self._source, behind_docstring)]
        ends = [match.start() for match in begun[1:]] + [len(self._source)]
        start = None
        for match, end in zip(begun, ends, strict=True):
            decorator, defined, imported, value = match.groups()
            start = match.start() if start is None else start
            if decorator:
                continue
            text, start = self._source[start:end], None
            if imported:
                self._parse(text)
            else:
                self._statements[defined or value] = text

    def _parse(self, text: str) -> None:
        """Add the functions, classes, values and imports of some source to the nodes."""
        for node in ast.parse(text).body:
            match node:
                case ast.FunctionDef(defined) | ast.ClassDef(defined):
                    self._nodes[defined] = node
                case ast.Assign([ast.Name(defined)], value):
                    self._nodes[defined] = value
                case ast.AnnAssign(ast.Name(defined), _, default):
                    self._nodes[defined] = default
                case ast.ImportFrom():
                    self._nodes |= {alias.asname or alias.name: node for alias in node.names}

    def find_node(self, name: str) -> ast.AST | None:
        """Return the function, class, value or import of that name, None where there is none."""
        if (text := self._statements.pop(name, None)) is not None:
            try:
                self._parse(text)
            except SyntaxError:
                self._parse(self._source)
        return self._nodes.get(name)

    def __missing__(self, name: str) -> Any:
        """Evaluate a name from the module's source, or import it. Raises KeyError."""
        match self.find_node(name):
            case ast.expr() as value:
                return self.evaluate(value)
            case ast.ImportFrom(str(origin)) if origin.startswith("slviewer."):
                return _read_module(origin)[name]
            case ast.ImportFrom(str(origin)):
                return getattr(import_module(origin), name)
        raise KeyError(name)

    def evaluate(self, expression: ast.expr) -> Any:
        """Evaluate an annotation or a default of the module."""
        return eval(ast.unparse(expression), {}, self)  # noqa: S307, our own source


_read_module = cache(_Module)


def _read_function(module: _Module, name: str) -> tuple[str, Described]:
    """Return what the docstring of a function says before ``Args:`` and below it, and the
    function's parameters; where it has settings, the latter are those of the settings."""
    definition = module.find_node(name)
    assert isinstance(definition, ast.FunctionDef)
    text, _, described = (ast.get_docstring(definition) or "").partition("\n\nArgs:\n")
    for decorator in definition.decorator_list:
        match decorator:
            case ast.Call(ast.Name("operation"), [_, _, ast.Name(settings)]):
                described, accepted = _read_settings(module, settings)
                session = ast.arg("session", ast.Name("SessionLike")), None, module
                described = f"    session: Session folder.\n{described}"
                return text, (described, [session, *accepted])
            case ast.Call(ast.Name("takes_settings"), [ast.Name(settings)]):
                return text, _read_settings(module, settings)
    arguments = definition.args
    required = [None] * (len(arguments.args) - len(arguments.defaults))
    pairs = [
        *zip(arguments.args, [*required, *arguments.defaults], strict=True),
        *zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True),
    ]
    if not described:
        text = text.partition("\n\n")[0]
    return text, (described.partition("\n\n")[0], [(*pair, module) for pair in pairs])


def _read_settings(module: _Module, name: str) -> Described:
    """Return what a dataclass of settings and its bases describe of their fields, and these
    fields."""
    match module.find_node(name):
        case ast.ImportFrom(str(origin)):
            return _read_settings(_read_module(origin), name)
        case ast.ClassDef() as settings:
            doc = ast.get_docstring(settings) or ""
    described = [doc.partition("Args:\n")[2].partition("\n\n")[0]]
    accepted = [
        (ast.arg(ast.unparse(node.target), node.annotation), node.value, module)
        for node in settings.body
        if isinstance(node, ast.AnnAssign)
    ]
    for base in settings.bases:
        inherited, further = _read_settings(module, ast.unparse(base))
        described.append(inherited)
        accepted += further
    return "\n".join(filter(None, described)), accepted


def _terminal_type(kind: Any) -> Any:
    """Return the type for the terminal, without what `Input` declares: `str | Path` becomes the
    first of both, sequences become tuples, and names or None are listed in their order."""
    if find_input(kind):
        kind = get_args(kind)[0]
    choices = get_args(kind)
    if len(choices) == 2 and choices[1] is type(None) and get_origin(choices[0]) is Literal:
        return Literal[(None, *get_args(choices[0]))]
    if Path in choices and str in choices:
        first = next(choice for choice in choices if choice in (Path, str))
        return first | None if type(None) in choices else first
    if getattr(kind, "__origin__", None) is Sequence:
        return GenericAlias(tuple, (_terminal_type(choices[0]), ...))
    return kind
