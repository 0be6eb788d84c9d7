"""Read a command line into the parameters of a function: its signature is what can be typed.

A parameter is ``Annotated[type, Option(...)]`` or ``Annotated[type, Argument(...)]``. One that says
neither is an option if it has a default, and an argument if it has none. A ``bool`` is a flag, a
list may be repeated. :mod:`argparse` reads the words.
"""

from __future__ import annotations

import argparse
import difflib
import inspect
import os
import re
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    NoReturn,
    Protocol,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from myoface.errors import ApiError

F = TypeVar("F", bound=Callable[..., None])

HELP = ("-h", "--help")
# A part of the place of a fault in a request: a member's name, or the number of a list's item
PART = re.compile(r"\.?[^.\[]+|\[[^\]]*\]")
# Members of requests -> parameters that are called otherwise; --url is the service's own
MEMBERS = {"url": "address", "expires_at": "days"}


class UsageError(Exception):
    """A command line that cannot be followed; the program then ends with 2."""


@dataclass(kw_only=True)
class Argument:
    """A value by its place; the rules about files and folders are those of a path."""

    help: str = ""
    metavar: str | None = None
    exists: bool = False
    file_okay: bool = True
    dir_okay: bool = True


class Option(Argument):
    """A value by its name, ``--like-this`` unless ``flags`` say another; or a flag."""

    def __init__(
        self,
        *flags: str,
        min: float | None = None,
        max: float | None = None,
        envvar: str | None = None,
        parser: Callable[[str], Any] | None = None,
        **rules: Any,
    ) -> None:
        super().__init__(**rules)
        self.flags = flags
        self.min = min
        self.max = max
        self.envvar = envvar  # the variable that stands in for it
        self.parser = parser


class Runnable(Protocol):
    """A command or a group of them, as the words of a command line name it."""

    @property
    def help(self) -> str:
        """A line about it."""

    def run(self, words: Sequence[str], title: str) -> None:
        """Do what ``words`` say; ``title`` is what was typed before them."""


@dataclass(frozen=True)
class Command:
    """A function and the words that its parameters are read from."""

    function: Callable[..., None]
    help: str

    def run(self, words: Sequence[str], title: str) -> None:
        """Call the function with what ``words`` say."""
        parser = self.parser(title)
        joined = _join_value(parser, words)
        # argparse takes options between arguments, or a --, not both
        parse = parser.parse_args if "--" in joined else parser.parse_intermixed_args
        given = parse(joined)
        try:
            self.function(**vars(given))
        except ApiError as error:
            raise error.with_places(parser.typed_as) from None

    def parser(self, title: str) -> CommandParser:
        """Return the reader of the command's words."""
        about = inspect.getdoc(self.function) or self.help
        parser = CommandParser(prog=title, description=about.replace("%", "%%"), allow_abbrev=False)
        hints = get_type_hints(self.function, include_extras=True)
        for parameter in inspect.signature(self.function).parameters.values():
            _add(parser, parameter, hints[parameter.name])
        return parser


@dataclass
class Group:
    """Commands under one word."""

    help: str
    members: dict[str, Runnable] = field(default_factory=dict)

    def command(self, name: str | None = None, *, help: str | None = None) -> Callable[[F], F]:
        """Make a command of a function, by its own name unless another is given."""

        def add(function: F) -> F:
            words = name or function.__name__.replace("_", "-")
            self.members[words] = Command(function, help or _first_line(function))
            return function

        return add

    def run(self, words: Sequence[str], title: str) -> None:
        """Run the command that the first of the words names, or list what there is."""
        if not words or words[0] in HELP:
            print("\n".join(self.lines(title)))  # noqa: T201
            return
        name, *rest = words
        if name.startswith("-"):
            raise UsageError(f"options come after the command: {title} COMMAND {name} ...")
        if name not in self.members:
            near = difflib.get_close_matches(name, self.members, 1)
            advice = (
                f"did you mean {near[0]!r}?" if near else f"there are {', '.join(self.members)}"
            )
            raise UsageError(f"{title} has no command {name!r}: {advice}")
        self.members[name].run(rest, f"{title} {name}")

    def lines(self, title: str) -> Iterator[str]:
        """Yield the lines that tell what there is."""
        yield f"usage: {title} COMMAND ..."
        yield f"\n{self.help}\n"
        width = max(map(len, self.members))
        for name, member in self.members.items():
            yield f"  {name:{width}}  {member.help}"
        yield f"\nMore about one: {title} COMMAND --help"


class CommandParser(argparse.ArgumentParser):
    """A reader of words that raises :class:`UsageError`."""

    @property
    def option_strings(self) -> set[str]:
        """The options there are, as they are typed."""
        return set(self._option_string_actions)

    def takes_value(self, word: str) -> bool:
        """Return True if ``word`` is an option that another word follows."""
        return word in self.option_strings and self._option_string_actions[word].nargs != 0

    def typed_as(self, place: str) -> str:
        """Return a place in a request, such as ``options.unit``, as what is typed: ``--unit``."""
        parts = PART.findall(place)
        inside = [*range(1, len(parts)), 0] if parts[:1] == ["options"] else range(len(parts))[:1]
        for number in inside:
            if (action := self._action_of(parts[number])) is not None:
                name = action.option_strings[0] if action.option_strings else action.metavar
                rest = "".join(parts[number + 1 :])
                return f"{name} {rest.lstrip('.')}".strip()
        return place

    def _action_of(self, part: str) -> argparse.Action | None:
        """Return the option or argument that a member of a request is read from."""
        name = MEMBERS.get(part.lstrip("."), part.lstrip("."))
        known = {action.dest: action for action in self._actions}
        forms = (name, *(name.removesuffix(end) for end in ("s", "_id", "_mm")))
        return next((known[form] for form in forms if form in known), None)

    def error(self, message: str) -> NoReturn:
        """Refuse what was typed."""
        raise UsageError(f"{message}; see {self.prog} --help")


def _first_line(function: Callable[..., None]) -> str:
    return (inspect.getdoc(function) or "").partition("\n")[0]


def _join_value(parser: CommandParser, words: Sequence[str]) -> list[str]:
    """Return the words with a value such as ``-y`` joined to its option, as argparse wants it."""
    known = parser.option_strings
    joined: list[str] = []
    waiting = iter(words)
    for word in waiting:
        if word == "--":  # only arguments from here on
            return [*joined, word, *waiting]
        following = None
        if parser.takes_value(word):
            following = next(waiting, None)
        if following is None:
            joined.append(word)
        elif following.startswith("-") and following not in known:
            joined.append(f"{word}={following}")
        else:
            joined += [word, following]
    return joined


def _add(parser: argparse.ArgumentParser, parameter: inspect.Parameter, hint: Any) -> None:
    """Add what a parameter is read from."""
    kind, rules = _parts(hint)
    default = parameter.default
    is_required = default is inspect.Parameter.empty
    if rules is None:
        rules = Argument() if is_required else Option()
    is_list = get_origin(kind) is list
    each = get_args(kind)[0] if is_list else kind
    if isinstance(rules, Option) and rules.envvar and os.environ.get(rules.envvar):
        default = os.environ[rules.envvar]
        is_required = False
    how: dict[str, Any] = {"help": _help(rules, each, None if is_required else default)}
    if each is not bool:
        how |= {"type": _reader(each, rules), "metavar": rules.metavar, **_choices(each)}
    if not isinstance(rules, Option):
        how["metavar"] = rules.metavar or parameter.name.upper()
        how["nargs"] = ("+" if is_required else "*") if is_list else None if is_required else "?"
        parser.add_argument(parameter.name, default=None if is_required else default, **how)
        return
    flags = rules.flags or (f"--{parameter.name.replace('_', '-')}",)
    if each is bool:
        can_be_denied = default is True or not rules.flags
        how["action"] = argparse.BooleanOptionalAction if can_be_denied else "store_true"
    elif is_list:
        how["action"] = "append"
    parser.add_argument(
        *flags,
        dest=parameter.name,
        required=is_required,
        default=None if is_required else default,
        **how,
    )


def _parts(hint: Any) -> tuple[Any, Argument | None]:
    """Return a parameter's type without None, and what it says about the command line."""
    rules = None
    if get_origin(hint) is Annotated:
        hint, *notes = get_args(hint)
        rules = next((note for note in notes if isinstance(note, Argument)), None)
    if get_origin(hint) in (Union, types.UnionType):
        hint, *others = [each for each in get_args(hint) if each is not type(None)]
        if others:
            hint = str
    if get_origin(hint) is Annotated:  # Annotated[X, ...] | None
        hint, *_ = get_args(hint)
    return hint, rules


def _help(rules: Argument, kind: Any, default: Any) -> str:
    words = rules.help.replace("%", "%%")
    if kind is bool or default in (None, "") or "default:" in words:
        return words
    return f"{words} (default: {default})".strip()


def _choices(kind: Any) -> Mapping[str, Any]:
    return {"choices": get_args(kind)} if get_origin(kind) is Literal else {}


def _reader(kind: Any, rules: Argument) -> Callable[[str], Any]:
    """Return what makes a value of a word; a fault of the word is told in words."""

    def read(word: str) -> Any:
        try:
            value = convert(word)
        except (ValueError, TypeError) as error:
            told = str(error) if parser else f"{word!r} is no {NAMES.get(kind, 'such value')}"
            raise argparse.ArgumentTypeError(told) from error
        if isinstance(value, Path):
            _check_path(value, rules)
        elif isinstance(rules, Option) and isinstance(value, (int, float)):
            _check_bounds(value, rules)
        return value

    parser = rules.parser if isinstance(rules, Option) else None
    convert = parser or kind
    if get_origin(kind) is Literal:
        values = {str(each): each for each in get_args(kind)}

        def convert(word: str) -> Any:
            return values.get(word, word)  # argparse tells what there is to choose from

    return read


NAMES = {int: "whole number", float: "number"}


def _check_path(path: Path, rules: Argument) -> None:
    try:
        is_there = path.exists()
    except OSError as error:
        raise argparse.ArgumentTypeError(f"{path}: {error.strerror}") from error
    if rules.exists and not is_there:
        raise argparse.ArgumentTypeError(f"there is no {path}")
    if rules.exists and not os.access(path, os.R_OK):
        raise argparse.ArgumentTypeError(f"{path} cannot be read")
    if not rules.dir_okay and path.is_dir():
        raise argparse.ArgumentTypeError(f"{path} is a folder; a file is needed")
    if not rules.file_okay and path.is_file():
        raise argparse.ArgumentTypeError(f"{path} is a file; a folder is needed")


def _check_bounds(value: float, rules: Option) -> None:
    if rules.min is not None and not value >= rules.min:  # what is no number is refused, too
        raise argparse.ArgumentTypeError(f"{value} is less than {rules.min}")
    if rules.max is not None and not value <= rules.max:
        raise argparse.ArgumentTypeError(f"{value} is more than {rules.max}")
