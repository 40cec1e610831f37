"""Writes the reference pages that are made from the program into ``docs/generated``; ``docs/conf.py`` calls it.

The pages are not committed. For each one ``docs/reference`` has a page that includes it.
"""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Literal, get_args, get_origin

import typer
from pydantic import BaseModel

from controller.__main__ import application
from controller.config import StageTables
from controller.panel.api import document
from hal.registry import load_drivers

DOCS: Final = Path(__file__).resolve().parent
ROOT: Final = DOCS.parent
GENERATED: Final = DOCS / "generated"
DOCUMENTED: Final = ("controller", "hal")
RAISING: Final = ("controller", "hal", "plugins", "lab")
STABLE: Final = "controller.api"
API_ORDER: Final = ("captures", "codes", "calibration", "transport", "solving", "results")
CODE: Final = re.compile(r"^[a-z<][a-z0-9<>_]*(-[a-z0-9<>_]+)+$|^[a-z]{4,}$")


def write_all() -> None:
    """Write every page. Pages of modules that are gone are removed; unchanged pages keep their time."""
    pages = {
        "commands.md": commands(),
        "stage-toml.md": stage_toml(),
        "drivers.md": drivers(),
        "http-api.md": http_api(document()),
        "error-codes.md": error_codes(),
        "python-api.md": python_api(),
        **{f"api/{name}.md": page for name, page in api_pages()},
    }
    for old in GENERATED.rglob("*.md"):
        if str(old.relative_to(GENERATED)) not in pages:
            old.unlink()
    for name, page in pages.items():
        file = GENERATED / name
        if not file.exists() or file.read_text() != page:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(page)


def plain(text: str) -> str:
    """``text`` so that Markdown shows it as it is; text in backquotes stays code."""
    parts = re.split(r"(`[^`]+`)", " ".join(text.split()))
    return "".join(
        part.replace("|", "\\|")
        if part.startswith("`") and len(part) > 1
        else re.sub(r"([\\`*_<>|\[\]{}$#])", r"\\\1", part)
        for part in parts
    )


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    columns = list(head)
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)]) + "\n"


def code(text: object) -> str:
    return f"`{text}`".replace("|", "\\|")


# Commands


def commands() -> str:
    """Every command of the command line with its arguments and options."""
    return "\n".join(_command(path, command) for path, command in _commands(typer.main.get_command(application()), ()))


def _commands(command: Any, path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    if hasattr(command, "commands"):
        for name in command.list_commands(None):
            yield from _commands(command.get_command(None, name), (*path, name))
    else:
        yield path, command


def _command(path: tuple[str, ...], command: Any) -> str:
    arguments = [one for one in command.params if one.param_type_name == "argument"]
    options = [one for one in command.params if one.param_type_name == "option" and one.name != "help"]
    words = ["velatura", *path, *(_argument(one) for one in arguments), "[OPTIONS]" if options else ""]
    text = f"## velatura {' '.join(path)}\n\n{plain(command.help or '')}\n\n```text\n{' '.join(words).strip()}\n```\n\n"
    rows = [(code(_argument(one)), plain(one.help or "")) for one in arguments]
    rows += [(code(_option(one)), plain(one.help or "") + _default(one)) for one in options]
    return text + table(("argument or option", "meaning"), rows)


def _argument(argument: Any) -> str:
    name = (argument.metavar or argument.name).upper() + ("..." if argument.nargs == -1 else "")
    return name if argument.required else f"[{name}]"


def _option(option: Any) -> str:
    names = ", ".join((*option.opts, *option.secondary_opts))
    value = "|".join(option.type_descriptor.choices or ()) or (option.metavar or option.name).upper()
    return names if option.is_flag else f"{names} {value}"


def _default(option: Any) -> str:
    if option.is_flag or option.default in (None, "", ()):
        return " (may be repeated)" if option.multiple else ""
    return f" Default: {code(option.default)}."


# stage.toml


def stage_toml() -> str:
    """Every table and key of stage.toml."""
    return "\n".join(_tables(StageTables, ()))


def _tables(model: type[BaseModel], path: tuple[str, ...]) -> Iterator[str]:
    inner: list[tuple[str, type[BaseModel], bool]] = []
    rows = []
    for name, field in model.model_fields.items():
        found = _model_in(field.annotation)
        if found is not None:
            inner.append((name, found, get_origin(field.annotation) is tuple))
            continue
        default = "required" if field.is_required() else code(_toml(field.default))
        rows.append((code(name), default, plain(field.description or "")))
    if path:
        open_table = model.model_config.get("extra") == "allow"
        more = "\nThis table also takes the settings of its driver or kind.\n" if open_table else ""
        many = path[-1].startswith("[")
        title = ".".join(part.strip("[]") for part in path)
        heading = f"[[{title}]]" if many else f"[{title}]"
        if rows:
            yield f"## {heading}\n\n" + table(("key", "default", "meaning"), rows) + more
    for name, found, many in inner:
        yield from _tables(found, (*path, f"[{name}]" if many else name))


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) is Literal:
        return None
    return next((found for part in get_args(annotation) if (found := _model_in(part)) is not None), None)


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if value is None:
        return "none"
    return "[]" if value == () else f'"{value}"' if isinstance(value, str) else f"{value:g}"


# Drivers


def drivers() -> str:
    """Every driver that this installation has, with its settings, by kind of device."""
    text = []
    for driver in load_drivers(benches=False).list:
        rows = [
            (code(key), "yes" if key in driver.required else "", plain(meaning))
            for key, meaning in driver.settings.items()
        ]
        text.append(f"## {driver.kind.replace('_', ' ').capitalize()}: {driver.name}\n\n{plain(driver.summary)}\n")
        text.append(table(("setting", "required", "meaning"), rows) if rows else "It has no settings.\n")
    return "\n".join(text)


# HTTP API


def http_api(content: Mapping[str, Any]) -> str:
    """Every operation of the panel's OpenAPI document."""
    rows = []
    for path, methods in content["paths"].items():
        for method, operation in methods.items():
            role = re.sub(r"^Needs the role (\w+) or above\.$", r"\1", operation["description"])
            rows.append((code(f"{method.upper()} {path}"), plain(operation["summary"]), role, _input(operation)))
    return table(("request", "meaning", "role", "input"), rows)


def _input(operation: Mapping[str, Any]) -> str:
    found = [f"{code(one['name'])} ({one['in']})" for one in operation.get("parameters", ())]
    for kind, body in operation.get("requestBody", {}).get("content", {}).items():
        keys = body.get("schema", {}).get("properties", {})
        found += [f"{code(key)} (body)" for key in keys] or [f"a file as {code(kind)}"]
    return ", ".join(found)


# Error codes


def error_codes() -> str:
    """Every stable error code that the program's source names, with its sentences."""
    found: dict[str, set[tuple[str, str, str]]] = {}
    for package in RAISING:
        for file in sorted((ROOT / package).rglob("*.py")):
            for call in (node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Call)):
                keywords = {one.arg: _words(one.value) for one in call.keywords}
                name = _words(call.args[0]) if call.args else ""
                if {"what", "remedy"} <= set(keywords) and CODE.match(name) and re.search(r"\w\s\w", keywords["what"]):
                    kind = call.func.id if isinstance(call.func, ast.Name) else ""
                    found.setdefault(name, set()).add((kind, keywords["what"], keywords["remedy"]))
    rows = [
        (code(name), EXIT_CODES.get(kind, ""), plain(what), plain(remedy))
        for name in sorted(found)
        for kind, what, remedy in sorted(found[name])
    ]
    return table(("code", "exit", "what happened", "what to do"), rows)


EXIT_CODES: Final[Mapping[str, str]] = {
    "UsageError": "2",
    **dict.fromkeys(("WorkError", "CalibrationError", "BundleError", "VelaturaError"), "1"),
    **dict.fromkeys(
        ("DeviceError", "DeviceGone", "DeviceBusy", "DeviceTimeout", "DeviceRefused", "ProtocolError", "PluginError"),
        "3",
    ),
}


def _words(node: ast.expr) -> str:
    """A text as written in the source, with ``<name>`` where the program puts something in."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(_words(part) for part in node.values)
    if isinstance(node, ast.BinOp):
        return _words(node.left) + _words(node.right)
    if isinstance(node, ast.IfExp):
        return f"{_words(node.body)} / {_words(node.orelse)}"
    if isinstance(node, ast.FormattedValue):
        return f"<{_last_name(node.value)}>"
    return f"<{_last_name(node)}>"


def _last_name(node: ast.expr) -> str:
    names = [one.attr if isinstance(one, ast.Attribute) else one.id for one in ast.walk(node)
             if isinstance(one, ast.Attribute | ast.Name)]  # fmt: skip
    return names[0].strip("_").lower() if names else "..."


# Paths


def missing_paths() -> Iterator[str]:
    """Every page that the program's source or its files name by path (``docs/...md``), and that does not exist."""
    for top in (*RAISING, "tests", "firmware_configs"):
        for file in sorted((ROOT / top).rglob("*")):
            if file.suffix in (".py", ".toml", ".service", ".html"):
                for number, line in enumerate(file.read_text().splitlines(), 1):
                    for path in re.findall(r"\bdocs/[\w/.-]+\.md\b", line):
                        if not (ROOT / path).exists():
                            yield f"{file.relative_to(ROOT)}:{number} names {path}, which does not exist"


# Python API


def python_api() -> str:
    """What ``controller.api`` names, by its modules; the values of other modules come last."""
    module = importlib.import_module(STABLE)
    text = [f"```{{eval-rst}}\n.. automodule:: {STABLE}\n   :no-members:\n   :no-index:\n```\n"]
    own, values = {}, []
    for name in module.__all__:
        home = getattr(module, name).__module__
        if home.startswith(f"{STABLE}."):
            own.setdefault(home, []).append(name)
        else:
            values.append(name)
    for home in sorted(own, key=[f"{STABLE}.{name}" for name in API_ORDER].index):
        head, _, _ = (importlib.import_module(home).__doc__ or "").partition("\n")
        text.append(f"## {home.removeprefix(STABLE + '.').capitalize()}\n\n{plain(head)}\n")
        text += [_autoname(module, name) for name in sorted(own[home], key=str.swapcase)]
    text.append("## Values\n\nWhat the functions take and return, and what reads it from files.\n")
    # Their docstrings say what is in them; methods of other modules are not stable.
    text += [_autoname(module, name, members=False) for name in values]
    return "\n".join(text)


def _autoname(module: Any, name: str, *, members: bool = True) -> str:
    kind = "autoclass" if isinstance(getattr(module, name), type) else "autofunction"
    option = "" if members or kind == "autofunction" else "   :no-members:\n"
    return f"```{{eval-rst}}\n.. {kind}:: {STABLE}.{name}\n{option}```\n"


def api_pages() -> Iterator[tuple[str, str]]:
    """A page for each package: its name, and its modules with their public names, by autodoc."""
    for top in DOCUMENTED:
        for folder in sorted({file.parent for file in (ROOT / top).rglob("*.py")}):
            modules = [_module(file) for file in sorted(folder.glob("*.py")) if file.name != "__main__.py"]
            if modules:
                package = ".".join(folder.relative_to(ROOT).parts)
                yield package, f"# {package}\n\n" + "\n".join(_automodule(name, package) for name in modules)


def _module(file: Path) -> str:
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _automodule(name: str, package: str) -> str:
    if name == package:  # what it exports is documented where it is defined
        return f"```{{eval-rst}}\n.. automodule:: {name}\n   :no-members:\n```\n"
    return f"## {name.removeprefix(package + '.')}\n\n```{{eval-rst}}\n.. automodule:: {name}\n```\n"
