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
from dataclasses import KW_ONLY, dataclass, fields, is_dataclass, replace
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import GenericAlias, MappingProxyType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import tyro

from slviewer import terminal
from slviewer.errors import SlviewerError, UsageError
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
CONFIG = (
    tyro.conf.OmitArgPrefixes,
    tyro.conf.OmitSubcommandPrefixes,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.PositionalMetavarFromFieldName,
)
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
    described = "\n".join(each.text for each in parts)
    parameters, declared = [], dict[str, Input]()
    for each in (parameter for part in parts for parameter in part.list_described()):
        declared[each.name] = find_input(each.kind) or Input()
        kind, value = _terminal_type(each.kind), each.value
        if each.name in optional:
            kind, value = kind | None, None
        is_positional = each.name in positional or (each.name == "session" and each.is_required)
        kind = _annotate(kind, value, is_positional)
        if each.name in names:
            kind = Annotated[kind, tyro.conf.arg(name=names[each.name])]
        keyword = inspect.Parameter.KEYWORD_ONLY
        parameters.append(inspect.Parameter(each.name, keyword, annotation=kind, default=value))

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
    parse.__doc__ = (description or _remove_errors(text)) + (joined and f"\n\nArgs:\n{joined}")
    parse.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    parse.__annotations__ = {each.name: each.annotation for each in parameters}
    parse.options = {  # type: ignore[attr-defined]
        _option(f"no_{each.name}" if each.default is True else names.get(each.name, each.name))
        for each in parameters
        if tyro.conf.Positional not in get_args(each.annotation)
    }
    return parse


def read_description(source: str) -> str:
    """Return what the function ``module:function`` says of itself, without reading its
    arguments."""
    return _remove_errors(_read_function(*_find_module(source))[0])


def parse_command(command: Function, name: str, arguments: Sequence[str]) -> Work:
    """Return the work of a command with these arguments of the terminal; ``name``: of the command.

    Raises UsageError for an option that the command does not have, before tyro assigns the words
    behind it to other arguments; SystemExit for the help and for what tyro refuses.
    """
    known = {"--help", *command.options}  # type: ignore[attr-defined]
    for each in arguments:
        option = _option(each.partition("=")[0].removeprefix("--"))
        if each.startswith("--") and each != "--" and option not in known:
            near = "".join(f" (did you mean {x}?)" for x in get_close_matches(option, known, 1))
            raise UsageError(
                f"{name} has no option {option}{near}",
                f"`slviewer {name} --help` lists its options",
            )
    with _REGISTRY:
        return tyro.cli(command, prog=f"slviewer {name}", args=arguments, config=CONFIG)


def _option(name: str) -> str:
    """Return the option of an argument."""
    return f"--{name.replace('_', '-')}"


_REGISTRY = tyro.constructors.ConstructorRegistry()


_NUMBERS: dict[Any, str] = {int: "a whole number such as 12", float: "a number such as 0.5 or 12"}


@_REGISTRY.primitive_rule
def _read_number(
    info: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
    """Read a number; another text is refused with an example."""
    kind = info.type
    if kind not in _NUMBERS:
        return None

    def parse(texts: list[str]) -> Any:
        """Return the number. Raises ValueError, with what is expected, for any other text."""
        try:
            return kind(texts[0])
        except ValueError:
            raise ValueError(f"{texts[0]!r} is not {_NUMBERS[kind]}") from None

    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=parse,
        is_instance=lambda value: isinstance(value, (int, kind)) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )


@_REGISTRY.primitive_rule
def _omit_none(
    info: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
    """Read an argument that may be None as one that may not: on the terminal it is omitted."""
    if get_origin(info.type) not in (Union, UnionType):
        return None
    kinds = [each for each in get_args(info.type) if each is not type(None)]
    if len(kinds) != 1:
        return None
    inner = replace(info, type=kinds[0], type_origin=get_origin(kinds[0]))
    spec = tyro.constructors.ConstructorRegistry.get_primitive_spec(inner)
    assert isinstance(spec, tyro.constructors.PrimitiveConstructorSpec)
    return replace(
        spec,
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: [] if value is None else spec.str_from_instance(value),
    )


def read_operation(source: str) -> Command:
    """Return the command of an operation ``module:function``. What has no default is positional, up
    to the first of several values."""
    positional = []
    for each in _read_function(*_find_module(source))[1].parameters:
        if not each.is_required or each.kind is KW_ONLY:
            break
        positional.append(each.name)
        if getattr(each.kind, "__origin__", None) is Sequence:
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


def _annotate(kind: Any, value: Any, is_positional: bool) -> Any:
    """Return a type for the terminal of an argument with this default, which its help omits where
    it states nothing."""
    is_empty = value is None or isinstance(value, bool) or value in ("", ())
    if is_empty or (is_positional and get_origin(kind) is tuple):
        kind = Annotated[kind, tyro.conf.arg(help_behavior_hint="")]
    return Annotated[kind, tyro.conf.Positional] if is_positional else kind


def _remove_errors(text: str) -> str:
    """Return a description without its sentences on exceptions and returned values, which are for
    Python, and with the terminal's quotes."""
    sentences = re.compile(r"(?:^|(?<=[.\n])[ \n])(?:Raises|Returns) [^\n]+(?:\n[^\n]+)*", re.M)
    return sentences.sub("", text).replace("``", "`").rstrip()


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
        declared[name].check(_option(names.get(name, name)), value)


@dataclass(frozen=True)
class _Parameter:
    """A parameter of a function, or a field of its settings, as the source of its ``module`` has
    it; ``default`` is None where there is none."""

    name: str
    annotation: ast.expr | None
    default: ast.expr | None
    module: "_SourceModule"

    @property
    def is_required(self) -> bool:
        """Whether it has no default."""
        return self.default is None

    @property
    def kind(self) -> Any:
        """Its type."""
        assert self.annotation is not None
        return self.module.evaluate(self.annotation)

    @property
    def value(self) -> Any:
        """Its default."""
        if self.default is None:
            return inspect.Parameter.empty
        return self.module.evaluate(self.default)


@dataclass(frozen=True)
class _Described:
    """All parameters of a function or its settings, and the ``text`` below ``Args:``."""

    text: str
    parameters: list[_Parameter]

    def list_described(self) -> list[_Parameter]:
        """Return the parameters that the text describes: the others are for Python alone."""
        return [
            each
            for each in self.parameters
            if re.search(rf"^ {{4}}{each.name}:", self.text, re.MULTILINE)
        ]


def _find_module(source: str) -> tuple["_SourceModule", str]:
    """Return module and name of ``module:name``, of slviewer's where it has that one."""
    module, _, name = source.partition(":")
    own = PACKAGE / f"{module.replace('.', '/')}.py"
    return _read_module(f"{PACKAGE.name}.{module}" if own.exists() else module), name


_STATEMENT = re.compile(
    r"^(?:(@)|(?:def|class) (\w+)|(from [\w.]+ import )|([A-Za-z_]\w*)(?=: | = ))", re.MULTILINE
)
"""Beginning of a statement of a module: a decorator, a definition, an import or a value."""


class _SourceModule(dict[str, Any]):
    """The names of a module, as `eval` looks them up, without importing the module and NumPy.

    Its source is split into statements, and each is parsed only when its name is looked up. A class
    or a function is a node of the source, a constant its value. What is imported from slviewer is
    read from the other module's source in the same way; other packages are imported.
    """

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
        code = compile(ast.fix_missing_locations(ast.Expression(expression)), self.name, "eval")
        return eval(code, {}, self)  # noqa: S307, our own source


_read_module = cache(_SourceModule)


def _read_function(module: _SourceModule, name: str) -> tuple[str, _Described]:
    """Return what the docstring of a function says before ``Args:`` and below it, and the
    function's parameters; where it has settings, the latter are those of the settings."""
    definition = module.find_node(name)
    assert isinstance(definition, ast.FunctionDef)
    text, _, described = (ast.get_docstring(definition) or "").partition("\n\nArgs:\n")
    for decorator in definition.decorator_list:
        match decorator:
            case ast.Call(ast.Name("operation"), [_, _, ast.Name(settings)]):
                own = _read_settings(module, settings)
                session = _Parameter("session", ast.Name("SessionLike", ast.Load()), None, module)
                described = f"    session: Session folder.\n{own.text}"
                return text, _Described(described, [session, *own.parameters])
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
    parameters = [_Parameter(each.arg, each.annotation, value, module) for each, value in pairs]
    return text, _Described(described.partition("\n\n")[0], parameters)


def _read_settings(module: _SourceModule, name: str) -> _Described:
    """Return what a dataclass of settings and its bases describe of their fields, and these
    fields."""
    match module.find_node(name):
        case ast.ImportFrom(str(origin)):
            return _read_settings(_read_module(origin), name)
        case ast.ClassDef() as settings:
            doc = ast.get_docstring(settings) or ""
    described = [doc.partition("Args:\n")[2].partition("\n\n")[0]]
    accepted = [
        _Parameter(ast.unparse(node.target), node.annotation, node.value, module)
        for node in settings.body
        if isinstance(node, ast.AnnAssign) and ast.unparse(node.annotation) != "ClassVar"
    ]
    for base in settings.bases:
        inherited = _read_settings(module, ast.unparse(base))
        described.append(inherited.text)
        accepted += inherited.parameters
    return _Described("\n".join(filter(None, described)), accepted)


def _terminal_type(kind: Any) -> Any:
    """Return the type for the terminal, without what `Input` declares: `str | Path` becomes the
    first of both, and sequences become tuples."""
    if find_input(kind):
        kind = get_args(kind)[0]
    choices = get_args(kind)
    if Path in choices and str in choices:
        first = next(choice for choice in choices if choice in (Path, str))
        return first | None if type(None) in choices else first
    if getattr(kind, "__origin__", None) is Sequence:
        return GenericAlias(tuple, (_terminal_type(choices[0]), ...))
    return kind
