"""What the reference says about options, settings, messages and Python: generated from the code, so that it stays true.

A hook of mkdocs (https://www.mkdocs.org/user-guide/configuration/#hooks): a line ``<!-- generated: NAME -->`` in a page
becomes what the function of that name in `SECTIONS` returns.
"""

from __future__ import annotations

import argparse
import inspect
import os
import re
from collections.abc import Callable
from typing import Any, get_args

from pydantic import BaseModel

MARKER = re.compile(r"^<!-- generated: ([\w-]+) -->$", re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill in the markers of a page (an event of mkdocs)."""
    return MARKER.sub(lambda match: SECTIONS[match[1]](), markdown)


def commands() -> str:
    """The help of every command and of its subcommands."""
    from fusion.cli import COMMANDS, parser_of

    os.environ["COLUMNS"] = "100"  # what argparse wraps at
    parts = []
    for name, (module, purpose) in COMMANDS.items():
        parser = parser_of(name)
        parts += [f"## {name}", f"`violearner {name}`, or `python -m {module}`: {purpose}.", _help(parser)]
        for sub_name, sub_parser in _subcommands(parser).items():
            parts += [f"### {name} {sub_name}", _help(sub_parser)]
    return "\n\n".join(parts)


def _subcommands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    found = [action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    return dict(found[0]) if found else {}


def _help(parser: argparse.ArgumentParser) -> str:
    return f"```text\n{parser.format_help().rstrip()}\n```"


def configuration() -> str:
    """A table for every section of the configuration, with types, defaults and what is written about them."""
    from fusion.config import RunConfig

    own = {name: field for name, field in RunConfig.model_fields.items() if _section(field.annotation) is None}
    parts = ["## At the top", _table(own)]
    for name, field in RunConfig.model_fields.items():
        if (section := _section(field.annotation)) is not None:
            parts += [f"## [{name}]", (inspect.getdoc(section) or "").replace("*", r"\*"), _table(section.model_fields)]
    return "\n\n".join(parts)


def _section(annotation: Any) -> type[BaseModel] | None:
    return annotation if isinstance(annotation, type) and issubclass(annotation, BaseModel) else None


def _table(fields: dict[str, Any]) -> str:
    rows = [f"| `{name}` | {_kind(field.annotation)} | {_value(field.default)} |" for name, field in fields.items()]
    return "\n".join(["| name | type | default |", "| --- | --- | --- |", *rows])


def _kind(annotation: Any) -> str:
    """A type in plain words."""
    arguments = [each for each in get_args(annotation) if each is not type(None)]
    if arguments and all(isinstance(each, str) for each in arguments):
        return " or ".join(f'`"{each}"`' for each in arguments)
    if getattr(annotation, "__origin__", None) is tuple:
        return "list of numbers"
    if arguments and not isinstance(annotation, type):
        return _kind(arguments[0])
    names = {"float": "number", "int": "whole number", "bool": "true or false", "str": "text", "Path": "file"}
    return names.get(getattr(annotation, "__name__", ""), str(annotation))


def _value(default: Any) -> str:
    if default is None:
        return "none"
    if isinstance(default, bool):
        return f"`{str(default).lower()}`"
    return f"`{list(default)}`" if isinstance(default, tuple) else f"`{default!r}`".replace("'", '"')


def messages() -> str:
    """The definitions of our own messages."""
    from fusion_io import messages

    parts = []
    for name in (messages.PAIR_ESTIMATE, messages.ESTIMATOR_STATE):
        definition = messages.schema_text(name).partition("=" * 80)[0].rstrip()
        parts.append(f"### {name}\n\n```text\n{definition}\n```")
    return "\n\n".join(parts)


def python() -> str:
    """The functions that are meant to be called from Python."""
    import fusion
    import fusion_io
    import learned

    parts = []
    for package, name in (
        (fusion_io, "open_log"),
        (fusion_io, "Log"),
        (learned, "estimate_pairs"),
        (fusion, "fuse"),
        (fusion, "evaluate"),
        (fusion_io, "PairEstimate"),
        (fusion_io, "ImuSeries"),
        (fusion_io, "Trajectory"),
        (fusion_io, "EstimatorSeries"),
        (fusion, "Metrics"),
    ):
        thing = getattr(package, name)
        parts.append(f"### {package.__name__}.{name}\n\n```text\n{_signature(thing)}{inspect.getdoc(thing)}\n```")
        if name == "Log":
            parts.append(_methods(thing))
    return "\n\n".join(parts)


def _signature(thing: Any) -> str:
    return "" if isinstance(thing, type) else f"{thing.__name__}{inspect.signature(thing)}\n\n"


def _methods(thing: type) -> str:
    """The first lines of what is written about the public methods and properties."""
    rows = [
        f"| `{name}` | {(inspect.getdoc(member) or '').partition(chr(10))[0]} |"
        for name, member in vars(thing).items()
        if not name.startswith("_") and (callable(member) or isinstance(member, property))
    ]
    return "\n".join(["| of a log | |", "| --- | --- |", *rows])


SECTIONS: dict[str, Callable[[], str]] = {
    "commands": commands,
    "configuration": configuration,
    "messages": messages,
    "python": python,
}
